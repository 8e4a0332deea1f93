"""One model in, its tables out."""
