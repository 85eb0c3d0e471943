"""Benchmarks of graphvio, run by ``scripts/benchmark``.

Each module of a subcommand has a function ``add_parser(subparsers)``, which adds its parser and sets the default
``run`` to a function that takes the parsed arguments.
"""
