"""Many runs of one problem: tasks, chunks, stores, statistics, members in vectors."""
