"""The entry point of ``fgloc``. What the command needs is imported inside, so that a signal may come meanwhile as at any time."""

import sys


def main() -> None:
    """The command ``fgloc``, which ends this process."""
    try:
        from factorgraph_loc.cli.stopping import stoppable

        with stoppable():
            from factorgraph_loc.cli.app import run

            run()
    except KeyboardInterrupt as stop:
        from factorgraph_loc.cli.stopping import end

        sys.exit(end(stop))
