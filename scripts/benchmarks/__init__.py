"""Benchmarks of graphvio, run by ``scripts/benchmark``.

A module that is a subcommand has ``add_parser(subparsers)``, which adds its parser and sets the default ``run`` to a
function that takes the parsed arguments.
"""
