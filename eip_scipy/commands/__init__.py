"""What the command line runs: one module, or a few, for each command.

``solar_system`` is the command of that name: options, text and files. Behind it stand `solar_run` (the runs),
`solar_errors` (how far each is from the truth), `solar_cost` (error against cost) and `solar_figures`. Behind
``charged_particle`` stand `particle_runs` and `particle_report` in the same way.
"""
