"""The entry point of ``fgloc``. Other modules are imported inside :func:`main`, so that a signal during the imports is handled."""

import gc
import sys


def main() -> None:
    """Run the command ``fgloc``, then exit."""
    gc.set_threshold(50_000)  # more frequent garbage collection would take a tenth of the time of a short command
    try:
        from factorgraph_loc.cli.stopping import stoppable, unwrapped

        with stoppable(), unwrapped():
            from factorgraph_loc.cli.app import run

            run()
    except KeyboardInterrupt as stop:
        from factorgraph_loc.cli.stopping import end

        sys.exit(end(stop))
