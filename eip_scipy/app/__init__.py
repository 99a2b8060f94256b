"""The command line: a folder for each field, a module or a few for each command.

``solar.solar_system`` is the command of that name: options, text and files. Behind it stand `solar.runs`,
`solar.errors` (how far each is from the truth), `solar.cost` (error against cost) and `solar.figures`. Behind
``particles.charged_particle`` stand `particles.runs` and `particles.report` in the same way.
"""
