"""Scenes with known truth: `scene` simulates, `adjust` adjusts and writes, `demo` is the collection of the demo."""
