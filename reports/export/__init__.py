"""Lists, models and benchmark files without the rejected images."""
