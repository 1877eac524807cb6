"""The subcommands: a module each, and what several of them share."""
