"""The subcommands, a module each, and their common parts."""
