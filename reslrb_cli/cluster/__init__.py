"""Steps computed by several processes: workers of dask.distributed compute the shards of `optimization/shards.py`."""
