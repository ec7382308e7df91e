"""The entry point of ``fgloc``. Imports are inside the function, so that signals are handled while they run."""

import gc
import sys


def main() -> None:
    """Run the command ``fgloc``, then exit."""
    gc.set_threshold(50_000)  # to search its many modules for garbage takes a tenth of a short command
    try:
        from factorgraph_loc.cli.stopping import stoppable, unwrapped

        with stoppable(), unwrapped():
            from factorgraph_loc.cli.app import run

            run()
    except KeyboardInterrupt as stop:
        from factorgraph_loc.cli.stopping import end

        sys.exit(end(stop))
