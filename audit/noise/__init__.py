"""How noisy are the observations, and what is standard normal if that is all? (method.md sections 2 and 3)."""
