"""A sweep by workers of Dask, in a process of its own that can be killed; and what workers load.

`dask_child.py STORE SCHEDULER_FILE TIME` is the client; `--preload dask_child.py` has a worker
write into the log which units it computes and records.
"""

import os
import sys
import time


def note(word, unit="-"):
    """One line, in one go, as others write there too."""
    line = f"{os.getpid()} {time.time():.3f} {word} {unit}\n"
    file = os.open(os.environ["JAXCHAIN_FAULTS_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, line.encode())
    os.close(file)


def dask_setup(worker):
    """What Dask calls in a worker that has loaded this."""
    from jaxchain.sweeps.store import Store

    write = Store.write

    def noted(self, block, *more):
        note("computed", block.name)
        write(self, block, *more)
        note("recorded", block.name)

    setattr(Store, "write", noted)  # noqa: B010


def initial(chain, excited):
    from jaxchain import equation_8

    return equation_8(chain, excited)


def run(path, time, **more):
    import numpy as np

    from jaxchain import Amplitude, paper_chain, sweep

    over = {"belt_speed": np.linspace(1.0, 1.6, 7), "excited": [0, 1, 2, 1, 2]}
    return sweep(
        paper_chain(2, belt_speed=1.4, width=None), lambda chain, excited: initial(chain, excited),
        time, over=over, observe=Amplitude(window=20.0), lanes=4, store=path,
        chunks={"belt_speed": 2, "excited": 2}, **more,
    )  # fmt: skip


def main():
    import jaxchain
    from jaxchain.sweeps import StoreError

    jaxchain.configure(devices=1)
    path, scheduler, time = sys.argv[1], sys.argv[2], float(sys.argv[3])
    try:
        if scheduler == "none":
            run(path, time)
        else:
            from distributed import Client

            with Client(scheduler_file=scheduler, timeout=60) as client:
                note("starts")
                run(path, time, client=client)
    except StoreError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    note("ends")


if __name__ == "__main__":
    main()
