"""``eip-scipy bench``: comparison of this package with other packages, on one machine.

`suites` defines the problems and settings, `peers` how each package is called. `worker` is the process that runs one of
them, `process` starts it and reads its answers, `compare` finds the costs at equal error, and `page` and `figures` make
the report.
"""
