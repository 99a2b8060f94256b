"""The studies and the command line ``eip-scipy``: commands that reproduce, measure and compare.

The package is built on the public interface of `eip_scipy`, which never loads it. Each field has a folder. Each command
is one module or a few.

`commands` is the table of commands, `study` defines a command and its runner, and `cli` reads the options. Several
commands share `report` (numbers and tables as text, complete files), `work_precision` (error against cost), `timing`
(functions that are timed in turn), `long_runs` (checkpoints), `beside` (a second process), `plotting` (figures),
`comparators` (methods to compare with), `hard_cases` (problems with exact ends). `measurements` has the commands
``eip-scipy study NAME``, which are behind the numbers of the documentation.

``solar.solar_system`` is the command of that name. It uses `solar.runs`, `solar.errors` (distance of each run from
the truth), `solar.cost` (error against cost), `solar.report` and `solar.figures`.
"""
