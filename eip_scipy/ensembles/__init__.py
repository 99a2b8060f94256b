"""Many runs of one problem: tasks, chunks, checkpoints, vectorised members."""
