"""Which models lie below a folder, what are they called, and did they change? Asked before anything is read."""
