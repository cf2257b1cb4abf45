"""dask: tasks, stages, the cluster."""
