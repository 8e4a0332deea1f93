"""Benchmark scene_info files, read without executing what they hold."""
