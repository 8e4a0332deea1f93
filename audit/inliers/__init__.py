"""Which observations enter, and what is left of each after projection? (method.md section 1)."""
