"""`counterspin certificate`: a result as Digital Calibration Certificate."""

from __future__ import annotations

import sys
from collections.abc import Callable
from getpass import getpass
from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.cli.words import OutputFile, group, say
from counterspin.errors import CampaignError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.certificates.signers import Signer


@group
@frozen
class Proof:
    """What a certificate is held to: the schema, and a signature.

    Parameters
    ----------
    schema
        Folder or file of the schema of DCC, to validate against.
    key
        Private key to sign with: PEM, or PKCS #12 with its certificate. If it is encrypted, its
        password is asked for, or read from standard input where that is no terminal.
    signer
        In place of a key: a command that reads bytes on standard input and writes their signature,
        such as that of a card or token.
    cert
        X.509 certificate (PEM): of the key, or with --verify of who must have signed.
    both
        Write the other of the two, XML and PDF, beside it, of the same signature.
    """

    schema: Path | None = None
    key: Path | None = None
    signer: str | None = None
    cert: Path | None = None
    both: bool = False

    def who_signs(self) -> Callable[[], Signer] | None:
        """Return what reads the key; None if none is given."""
        from counterspin.certificates.signers import command_signer

        key, command, cert = self.key, self.signer, self.cert
        if command is not None and key is not None:
            raise CampaignError("certificate", ["give --key or --signer, not both"])
        if command is not None:
            if cert is None:
                raise CampaignError("certificate", ["give --signer and --cert together"])
            return lambda: command_signer(command, cert)
        if key is None:
            if cert is not None:
                raise CampaignError("certificate", ["--cert: give --key or --signer too"])
            return None
        return lambda: _read_signer(key, cert)


def _read_signer(key: Path, cert: Path | None) -> Signer:
    """Read a key, and ask for its password if it has one."""
    from counterspin.certificates.signers import PasswordNeededError, read_signer

    try:
        return read_signer(key, cert)
    except PasswordNeededError:
        return read_signer(key, cert, _password(key))


def _password(key: Path) -> str:
    if sys.stdin is None:
        raise CampaignError(
            "certificate", [f"{key}: is encrypted; give its password on standard input"]
        )
    if sys.stdin.isatty():
        return getpass(f"Password of {key}: ")
    return sys.stdin.readline().rstrip("\r\n")


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

#: What is said of a PDF's pages.
_PAGES = {
    None: "This is of the XML that is attached to the PDF; its pages were not checked.",
    "none": "This is of the XML that is attached to the PDF; its pages are not signed.",
    "valid": "The pages carry a valid signature of the same signer.",
}


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
        other_kind,
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
            say(_PAGES[checked.pages])
        return
    if result is None or lab is None or output is None:
        raise CampaignError("certificate", ["give RESULT, LAB.toml, and -o FILE.xml or FILE.pdf"])
    if (grounds.amends is None) != (grounds.reason is None):
        raise CampaignError("certificate", ["give --amends OLD.xml and --reason WHY together"])
    check_place(output)
    outputs = [output, *([other_kind(output)] if proof.both else [])]
    for place in outputs[1:]:
        check_place(place)
    done = make(
        result,
        lab,
        schema=proof.schema,
        signer=proof.who_signs(),
        despite=grounds.despite,
        amends=None
        if grounds.amends is None or grounds.reason is None
        else Amendment(grounds.amends, grounds.reason),
    )
    for place in outputs:
        done.write(place, ledger=grounds.ledger)
    files, names = " and ".join(map(str, outputs)), ", ".join(done.accelerometers)
    say(f"Wrote {files}: certificate {done.identifier} of {names}.")
    for note in done.notes:
        say(note)
