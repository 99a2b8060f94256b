"""The command ``eip-scipy trust``: systems, a table of runs, their execution, and the counts."""
