"""Steps computed by several processes: the shards of `optimization/shards.py` on workers of dask.distributed."""
