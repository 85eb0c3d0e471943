"""``python -m graphvio``: the command line."""

from graphvio.cli import main

main()
