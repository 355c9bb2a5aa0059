"""`counterspin certificate`: a result as Digital Calibration Certificate."""

from __future__ import annotations

from pathlib import Path

from counterspin.cli.words import OutputFile, group, say
from counterspin.errors import CampaignError
from counterspin.frozen import frozen


@group
@frozen
class Signature:
    """What a certificate is signed with, or must have been signed with.

    Parameters
    ----------
    key
        Private key (PEM) to sign with, not encrypted.
    cert
        X.509 certificate (PEM): of the key, or with --verify of who must have signed.
    """

    key: Path | None = None
    cert: Path | None = None


_UNSIGNED = Signature()


def certificate(
    result: Path | None = None,
    lab: Path | None = None,
    /,
    *,
    output: OutputFile = None,
    schema: Path | None = None,
    signature: Signature = _UNSIGNED,
    init: Path | None = None,
    verify: Path | None = None,
    despite: str | None = None,
) -> None:
    """Write the Digital Calibration Certificate of a result, or check one.

    Parameters
    ----------
    result
        Result that `counterspin calibrate --json` wrote.
    lab
        What the laboratory says: LAB.toml.
    output
        The certificate: .xml, or .pdf with the XML attached (PDF/A-3).
    schema
        Folder or file of the schema of DCC, to validate against.
    init
        In place of all else: write a commented example of LAB.toml to this file.
    verify
        In place of a result: a certificate, XML or PDF, to check it and print its numbers.
    despite
        Certify a result that its records contradict, for this reason, which the certificate states.
    """
    from counterspin.certificates.issuing import (
        certificate_blocks,
        check_certificate,
        issue_certificate,
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
        checked = check_certificate(verify, schema=schema, cert=signature.cert)
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
        if verify.suffix.lower() == ".pdf":
            say("This is of the XML that is attached to the PDF; its pages are not signed.")
        return
    if result is None or lab is None or output is None:
        raise CampaignError("certificate", ["give RESULT, LAB.toml, and -o FILE.xml or FILE.pdf"])
    done = issue_certificate(
        result,
        lab,
        output,
        schema=schema,
        key=signature.key,
        cert=signature.cert,
        despite=despite,
    )
    say(f"Wrote {output}: certificate {done.identifier} of {', '.join(done.accelerometers)}.")
    for note in done.notes:
        say(note)
