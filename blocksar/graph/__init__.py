"""The task graph on dask: tasks, stages, and the cluster that runs them."""
