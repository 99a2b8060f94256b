"""``eip-scipy bench``: comparison of this package with other packages, on one machine.

`suites` defines the problems and settings, and `peers` the way to call each package. `worker` is the process that runs
one method of one package, `process` starts it and reads its answers, `compare` computes the times at equal error, and
`page` and `figures` make the report.
"""
