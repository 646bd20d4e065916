"""A sweep in a store, in a process of its own that can be killed; and what workers of Dask load.

`child.py STORE SCHEDULER_FILE|none` sweeps, and writes into a log when it starts and ends;
`--preload child.py` has a worker write which units it has computed.
"""

import os
import sys

import jaxchain


def note(word):
    """One line, in one go, as others write there too."""
    file = os.open(os.environ["JAXCHAIN_FAULTS_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, f"{os.getpid()} {word}\n".encode())
    os.close(file)


def noted(owner, name, word):
    """Notes each call of a method that has ended."""
    method = getattr(owner, name)

    def called(*arguments, **named):
        result = method(*arguments, **named)
        note(word)
        return result

    setattr(owner, name, called)


def dask_setup(worker):
    """The function that Dask calls in a worker that has loaded this."""
    from jaxchain.sweeps.scheduler import Scheduler

    noted(Scheduler, "run", "computed")


def run(path, **more):
    import numpy as np

    from jaxchain import Amplitude, equation_8, paper_chain, sweep

    over = {"belt_speed": np.linspace(1.0, 1.6, 7), "excited": [0, 1, 2, 1, 2]}
    return sweep(
        paper_chain(2, belt_speed=1.4, width=None),
        lambda chain, excited: equation_8(chain, excited),
        100000.0,
        over=over,
        observe=Amplitude(window=20.0),
        lanes=4,
        store=path,
        chunks={"belt_speed": 2, "excited": 2},
        **more,
    )


def main():
    from jaxchain.sweeps import StoreError
    from jaxchain.sweeps.store import Store

    path, scheduler = sys.argv[1:]
    jaxchain.configure(devices=2 if scheduler == "none" else 1)
    noted(Store, "write", "written")
    try:
        if scheduler == "none":
            note("starts")
            run(path)
        else:
            from distributed import Client

            with Client(scheduler_file=scheduler, timeout=60) as client:
                note("starts")
                run(path, client=client)
    except StoreError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    note("ends")


if __name__ == "__main__":
    main()
