"""The studies and the command line ``eip-scipy``: everything that reproduces, measures and compares.

The package is built on the public interface of `eip_scipy`, which never loads it. Each field has a folder, each command
one module or a few.

`commands` is the table of all, `study` what a command is and the one runner, `cli` reads the options. What several
commands need: `report` (numbers and tables as text, files that are whole or not there), `work_precision` (error
against cost), `timing` (functions that are timed in turn), `long_runs` (checkpoints), `beside` (a second process),
`plotting` (figures), `comparators` (methods to compare with), `hard_cases` (problems with exact ends). `measurements`
has the commands ``eip-scipy study NAME``, which are behind the numbers of the documentation.

``solar.solar_system`` is the command of that name; behind it stand `solar.runs`, `solar.errors` (how far each is from
the truth), `solar.cost` (error against cost), `solar.report` and `solar.figures`.
"""
