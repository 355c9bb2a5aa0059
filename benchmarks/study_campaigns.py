"""Timed studies of the paper's plan: stated sigma, estimated sigma, and varied truth."""

from __future__ import annotations

from importlib.resources import files

PAPER_FILE = files("counterspin.reproduction") / "paper.toml"

STATED_SIGMA = """
[study]
[study.analyses.exact]
method = "two-stage"
considered = []
"""
ESTIMATED_SIGMA = STATED_SIGMA + 'sigma = "residuals"\n'
VARIED_TRUTH = """
[study]
[study.vary]
K_F = { normal = "0.004 ± 2e-6 g" }
K_I = { normal = "1.001 ± 5e-6 g/g" }
K_II = { normal = "2e-5 ± 1e-6 g/g^2" }
K_III = { normal = "4e-6 ± 1e-6 g/g^3" }
K_IP = { normal = "6e-6 ± 1e-6 g/g^2" }
spindle.drift = { uniform = ["-5e-7 1/s", "5e-7 1/s"], per = "run" }
spindle.ripple.ratio = { uniform = ["0 ppm", "500 ppm"], per = "run" }
spindle.ripple.phase = { uniform = ["0 deg", "360 deg"], per = "run" }
centrifuge.radius = { normal = "2.5 ± 1e-5 m" }
[study.analyses.exact]
method = "two-stage"
"""


def describe_study(study: str) -> str:
    """Return the description of a study of the paper's plan."""
    paper = PAPER_FILE.read_text(encoding="utf-8")
    # The second stage of the peers has no uncertain scale factor.
    return (paper if study == VARIED_TRUTH else paper.replace("± 5e-6 g/g", "± 0 g/g")) + study
