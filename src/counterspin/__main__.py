"""`counterspin` and `python -m counterspin`: run one command in a process of its own."""

import sys

if __name__ == "__main__" and not sys.flags.safe_path:
    # `python -m` searches the working folder for modules first, so files there would be executed.
    # Up to here only Python itself has imported modules.
    del sys.path[0]

import gc
import os
from contextlib import AbstractContextManager, nullcontext
from typing import Final

#: Address space that libraries reserve while they are loaded, bytes. Some of them end the process
#: without a message if they do not get it.
_MIN_ADDRESS_SPACE: Final = 1_500_000_000


def run() -> int:
    """Run the command line in a process of its own and return the exit status."""
    if (limit := _address_space_limit()) is not None and limit < _MIN_ADDRESS_SPACE:
        print(
            f"counterspin: this process may take {limit / 1e9:.2g} GB of address space but needs "
            f"{_MIN_ADDRESS_SPACE / 1e9:g} GB to begin; raise the limit (ulimit -v)",
            file=sys.stderr,
        )
        return 1
    # The matrices are small: several threads cost more time than they save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # pydantic would search all installed packages for plugins, which are not used here.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Neither this process nor its children execute or read settings from the working folder.
    os.environ["PYTHONSAFEPATH"] = "1"
    # No window is opened. The backend that a notebook sets may not be installed here.
    os.environ["MPLBACKEND"] = "agg"
    # Imported modules stay: searching them for garbage would take longer than many a command.
    gc.set_threshold(1_000_000)
    # The threads that read records and compute checksums need the global interpreter lock often
    # and briefly, so the main thread must release it soon.
    sys.setswitchinterval(1e-4)
    try:
        with _prefetch_context():
            from counterspin.characters import install_substitution
            from counterspin.cli import main

            for stream in (sys.stdout, sys.stderr):
                install_substitution(stream)
            return main()
    except KeyboardInterrupt:
        return 130  # as in `main`, which may not be loaded yet
    finally:
        gc.freeze()


def _address_space_limit() -> int | None:
    """Return the limit of the address space of this process, in bytes; None: no limit."""
    if sys.platform == "win32":
        return None
    import resource

    soft_limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft_limit == resource.RLIM_INFINITY else soft_limit


def _prefetch_context() -> AbstractContextManager[None]:
    """Prefetch the files of the campaign if the command line calibrates a single campaign."""
    command, campaign, *further_arguments = [*sys.argv[1:], "", ""]
    if (
        command != "calibrate"
        or campaign[:1] in ("", "-")
        or further_arguments[0][:1] not in ("", "-")
    ):
        return nullcontext()
    from counterspin.campaign.checksums import prefetch_campaign

    return prefetch_campaign(campaign)


if __name__ == "__main__":
    sys.exit(run())
