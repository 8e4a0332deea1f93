"""Why is a model judged as it is, and would another camera model hold it? Evidence beyond the tables, and refits."""
