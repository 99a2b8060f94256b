"""``eip-scipy bench``: this package beside the field, on one machine.

`suites` says what is run, `peers` how each package is called, `worker` is the process that runs one of them, `process`
starts it and reads what it answers, `compare` finds the costs at equal error, `page` and `figures` make the report.
"""
