"""Where are models audited? In this process, in processes of this machine, or on a Dask cluster: one file each."""
