"""`counterspin certificate`: a result as Digital Calibration Certificate."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFile, group, say
from counterspin.errors import CampaignError
from counterspin.frozen import frozen


@group
@frozen
class Proof:
    """What a certificate is held to: the schema, and a signature.

    Parameters
    ----------
    schema
        Folder or file of the schema of DCC, to validate against.
    key
        Private key (PEM) to sign with, not encrypted.
    cert
        X.509 certificate (PEM): of the key, or with --verify of who must have signed.
    """

    schema: Path | None = None
    key: Path | None = None
    cert: Path | None = None


@group
@frozen
class Grounds:
    """Why a certificate is issued where it would not be without a reason, and where that is kept.

    Parameters
    ----------
    despite
        Certify a result that its records contradict, for this reason, which the certificate states.
    amends
        An issued certificate (XML or PDF) that the new one replaces; with --verify: that it must.
    reason
        Why it is replaced; the certificate states that, and what changed.
    ledger
        Enter the certificate there, in place of what LAB.toml says.
    """

    despite: str | None = None
    amends: Path | None = None
    reason: str | None = None
    ledger: Path | None = None


_UNPROVED = Proof()
_NONE_NEEDED = Grounds()


def certificate(
    result: Path | None = None,
    lab: Path | None = None,
    /,
    *,
    output: OutputFile = None,
    proof: Proof = _UNPROVED,
    grounds: Grounds = _NONE_NEEDED,
    init: Path | None = None,
    verify: Path | None = None,
) -> None:
    """Write the Digital Calibration Certificate of a result, or check one.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    lab
        What the laboratory says: LAB.toml.
    output
        The certificate: .xml, or .pdf with the XML attached (PDF/A-3a).
    init
        In place of all else: write a commented example of LAB.toml to this file.
    verify
        In place of a result: a certificate, XML or PDF, to check it and print its numbers.
    """
    from counterspin.certificates.amendment import Amendment
    from counterspin.certificates.issuing import certificate as make
    from counterspin.certificates.issuing import (
        certificate_blocks,
        check_certificate,
        check_place,
    )
    from counterspin.certificates.lab import write_example
    from counterspin.reports.text import Report, report_console

    if sum(given is not None for given in (result, init, verify)) != 1:
        raise CampaignError(
            "certificate", ["give RESULT and LAB.toml, or --init LAB.toml, or --verify FILE"]
        )
    if init is not None:
        say(f"Wrote {write_example(init)}. Fill it in; all of it is an example.")
        return
    if verify is not None:
        checked = check_certificate(
            verify, schema=proof.schema, cert=proof.cert, amends=grounds.amends
        )
        report_console().print(Report(list(certificate_blocks(checked.certified))))
        said = {
            "none": "It is not signed.",
            "unchecked": "It is signed, but the signature was not checked: give --cert CERT.pem.",
            "valid": "The signature is valid.",
        }
        say("", said[checked.signature])
        if checked.expired is not None:
            say(
                f"The signer's certificate expired on {checked.expired}; it was valid on the day "
                "of issue that the certificate states."
            )
        if (old := checked.certified.amends) is not None:
            checksum = " and its checksum is right" if grounds.amends is not None else ""
            say(f"It amends and replaces certificate {old}{checksum}.")
        if verify.suffix.lower() == ".pdf":
            say("This is of the XML that is attached to the PDF; its pages are not signed.")
        return
    if result is None or lab is None or output is None:
        raise CampaignError("certificate", ["give RESULT, LAB.toml, and -o FILE.xml or FILE.pdf"])
    if (grounds.amends is None) != (grounds.reason is None):
        raise CampaignError("certificate", ["give --amends OLD.xml and --reason WHY together"])
    check_place(output)
    done = make(
        result,
        lab,
        schema=proof.schema,
        key=proof.key,
        cert=proof.cert,
        despite=grounds.despite,
        amends=None
        if grounds.amends is None or grounds.reason is None
        else Amendment(grounds.amends, grounds.reason),
    )
    done.write(output, ledger=grounds.ledger)
    say(f"Wrote {output}: certificate {done.identifier} of {', '.join(done.accelerometers)}.")
    for note in done.notes:
        say(note)
