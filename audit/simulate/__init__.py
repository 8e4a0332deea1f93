"""Scenes with known truth: `scene` simulates, `adjust` adjusts and writes, `demo` is the collection of the demo.

`board` and `room` simulate single images with a lidar, for the estimators of audit.calibrate.
"""
