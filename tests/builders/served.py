"""A folder for `counterspin serve`: a campaign, its records and its results."""

import re
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from campaigns import SMALL, write_description

from counterspin.application.access_control import Credentials
from counterspin.application.jobs import Jobs
from counterspin.application.server import make_server, open_listener
from counterspin.calibration.calibrate import calibrate
from counterspin.simulation.simulate import simulate

#: Shorter than the other tests' campaign: nobody asks here what comes out.
SHORT = (
    SMALL.replace("revolutions = 20", "revolutions = 6")
    .replace("[site]", '[campaign]\ndate = "2026-01-12"\n\n[site]')
    .replace("[accelerometers.Qx]", '[accelerometers.Qx]\nserial_number = "17"')
)

#: Every place of the page beside the first, and one that there is not.
PLACES = (
    "/campaign/three",
    "/description/three",
    "/runs/three",
    "/live/three",
    "/import",
    "/try/three",
    "/plans",
    "/compare",
    "/history",
    "/result/three%2Fresult.json",
    "/certificate/three%2Fresult.json",
    "/manual/campaign#records",
    "/nowhere",
)

#: What a recorder's files do not say.
ANSWERS = {"gravity": "9.8066 m/s^2", "latitude": "45.75 deg", "radius": "2.5 m"}


def write_folder(folder: Path, plan: Path) -> Path:
    """Write a campaign, "three", its records and its result; return the folder.

    Parameters
    ----------
    folder
        What is served.
    plan
        Another folder, which takes what is simulated.
    """
    simulate(write_description(plan, SHORT, "plan.toml"), folder / "three")
    calibrate(folder / "three").write(folder / "three" / "result.json")
    return folder


@contextmanager
def run_server(app):
    """Run a server of a folder in a thread and yield its credentials."""
    with open_listener(0) as listener:
        credentials = Credentials(listener.getsockname()[1])
        server = make_server(app, credentials)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        yield credentials
        server.should_exit = True
        thread.join()


def find_answer_field(tab, words):
    """Return the field of an answer whose label begins with `words`."""
    return tab.get_by_label(re.compile(f"{words}(?!.*, (standard uncertainty|unit)$)"))


def read_token(credentials):
    """Return the single-use token of the page of a server."""
    return credentials.link.partition("#token=")[2]


def wait_for_job(page, number):
    """Wait for a job and return it."""
    deadline = time.monotonic() + 300.0
    while time.monotonic() < deadline:
        (job,) = (job for job in page.get("/api/jobs").json() if job["number"] == number)
        if job["state"] not in ("waiting", "running"):
            return job
        time.sleep(0.05)
    raise AssertionError(job)


class InlineJobs(Jobs):
    """Run jobs immediately in this process."""

    def _start_thread(self, job, work, words, then):
        *_, last_message = run_inline(work, *words)
        self._handle_message(job, last_message, then)
        assert job.state in ("done", "failed")
        assert "internal error" not in job.error, job.error


def run_inline(work, *words, questions=()):
    """Return all messages that a process would send in response to these questions."""
    messages, remaining_questions = [], iter(questions)

    def recv():
        try:
            return next(remaining_questions)
        except StopIteration:
            raise EOFError from None

    # The server's own process keeps its Ctrl-C.
    with patch("counterspin.application.jobs.signal.signal"):
        work(SimpleNamespace(send=messages.append, recv=recv), *words)
    return messages
