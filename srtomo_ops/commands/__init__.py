"""One module a sub-command: ``configure(parser)`` adds its arguments, ``main(arguments)`` runs it, returning the exit code."""
