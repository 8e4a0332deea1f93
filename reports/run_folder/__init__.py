"""How does a run reach the disk, and how is it read again? Parquet parts and run.json."""
