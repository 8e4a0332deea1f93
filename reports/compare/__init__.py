"""What changed between two runs, and does it pass a gate? For nightly checks."""
