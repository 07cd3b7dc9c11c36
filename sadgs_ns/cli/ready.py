"""Run a module's command line that comes later: `python -m sadgs_ns.cli.ready MODULE` imports the module meanwhile.

The command line is a line of JSON on the standard input, a list of its words. Without one nothing is run.
"""

from __future__ import annotations

import importlib
import json
import runpy
import sys


def main() -> None:
    """Import the module that the command line names, and run it when its own command line arrives."""
    module = sys.argv[1]
    importlib.import_module(module)
    if words := sys.stdin.readline():
        sys.argv = [module, *json.loads(words)]
        del sys.modules[module]  # Its code is run as a program's, while what it imported stays.
        runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
