"""One module a sub-command: ``configure(parser)`` adds its arguments, ``main(options)`` runs it: the exit code."""
