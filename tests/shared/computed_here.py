"""Planned runs that are made in this process. What would be sent to another is pickled all the same."""

import pickle
import time

from factorgraph_loc.experiments.execute import Executor, compute, execute


class Here(Executor):
    """Computes runs one after the other."""

    def __init__(self, *_):
        self._run = None

    def __exit__(self, *_):
        pass

    def submit(self, take, left):
        self._run = take()

    def finished(self):
        if self._run is None:
            time.sleep(0.01)
        else:
            yield self._run.key, sent(sent(compute)(sent(self._run)))


def run_planned(run, folder, *, again=False):
    """The state of one run, stored below ``folder``."""
    ((_, state),) = execute([run], folder, Here(), again=again)
    return state


def sent(what):
    return pickle.loads(pickle.dumps(what))
