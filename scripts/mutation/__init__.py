"""The parts of scripts/mutate_decision.py."""
