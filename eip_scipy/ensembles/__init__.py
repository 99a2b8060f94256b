"""Many runs of one problem: tasks, chunks, stores, statistics, vectorised members."""
