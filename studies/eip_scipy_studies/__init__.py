"""The studies and the command line ``eip-scipy``: commands that reproduce, measure and compare.

The package uses the public interface of `eip_scipy`, which never imports it. Each subject has a folder. Each command
consists of one module or a few.

`commands` is the table of commands, `study` defines a command and its runner, and `cli` reads the options. Several
commands share `report` (numbers and tables as text, and writing of files), `work_precision` (error against cost),
`timing` (functions that are timed in turn), `long_runs` (checkpoints), `beside` (further processes), `plotting`
(figures), `comparators` (methods to compare with), and `hard_cases` (problems with exact final states). `measurements`
has the commands ``eip-scipy study NAME``, which measure the numbers of the documentation.

``solar.command`` is the command ``solar-system``. It uses `solar.runs` (the methods and their runs), `solar.comparison`
(distance of each run from the truth), `solar.cost` (error against cost), `solar.truth` (force models against the
ephemeris) and `solar.figures`.
"""
