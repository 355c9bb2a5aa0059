"""`counterspin` and `python -m counterspin`: a process that runs one command and is over."""

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    # `python -m` looks for modules in the working folder first, and whatever lies there would be
    # run; only Python itself has looked so far.
    del sys.path[0]

import gc
import os
from contextlib import AbstractContextManager, nullcontext
from typing import Final

#: Address space that libraries reserve while they are loaded, bytes; some of them end the process
#: where they do not get it, before anybody could say why.
_LEAST_BYTES: Final = 1_500_000_000


def run() -> int:
    """Run the command line in a process of its own and return the exit status."""
    if (most := _most_bytes()) is not None and most < _LEAST_BYTES:
        print(
            f"counterspin: this process may take {most / 1e9:.2g} GB of address space but needs "
            f"{_LEAST_BYTES / 1e9:g} GB to begin; raise the limit (ulimit -v)",
            file=sys.stderr,
        )
        return 1
    # The matrices are small: more threads than one cost more than they bring.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic would look through all that is installed for plugins, which no one needs here.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Nothing in the working folder is run or obeyed, by what is started here neither.
    os.environ["PYTHONSAFEPATH"] = "1"
    # No window is opened, and what a notebook sets for its own process may not be installed here.
    os.environ["MPLBACKEND"] = "agg"
    # What is imported stays: to search it for garbage, now and at the end, takes longer than many
    # a command.
    gc.set_threshold(1_000_000)
    # The threads that read records and compute checksums need the interpreter's lock often and
    # briefly; the main thread must release it soon.
    sys.setswitchinterval(1e-4)
    try:
        with _head_start():
            from counterspin.characters import write_substitutes
            from counterspin.cli import main

            for stream in (sys.stdout, sys.stderr):
                write_substitutes(stream)
            return main()
    except KeyboardInterrupt:
        return 130  # as `main` has it, which is not loaded yet
    finally:
        gc.freeze()


def _most_bytes() -> int | None:
    """Return how much address space this process may take; None: as much as there is."""
    if sys.platform == "win32":
        return None
    import resource

    most, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if most == resource.RLIM_INFINITY else most


def _head_start() -> AbstractContextManager[None]:
    """Begin with the campaign to be calibrated, if the command line names one and no other."""
    command, where, *others = [*sys.argv[1:], "", ""]
    if command != "calibrate" or where[:1] in ("", "-") or others[0][:1] not in ("", "-"):
        return nullcontext()
    from counterspin.campaign.checksums import prefetch_campaign

    return prefetch_campaign(where)


if __name__ == "__main__":
    sys.exit(run())
