"""`counterspin certificate`: a result as Digital Calibration Certificate."""

from __future__ import annotations

import sys
from collections.abc import Callable
from getpass import getpass
from pathlib import Path
from typing import TYPE_CHECKING

from counterspin.cli.common import (
    OutputFile,
    command,
    make_prompts_interruptible,
    option_group,
    print_output,
)
from counterspin.errors import CampaignError, UsageError
from counterspin.frozen import frozen

if TYPE_CHECKING:
    from counterspin.certificates.issuing import Certificate
    from counterspin.certificates.signers import Signer


@option_group
@frozen
class SigningOptions:
    """Validation and signature of a certificate.

    Parameters
    ----------
    schema
        DCC schema (folder or file) to validate the certificate against.
    key
        Private key for the signature: PEM, or PKCS #12 with its certificate. counterspin prompts
        for the password of an encrypted key, or reads it from standard input if that is not a
        terminal.
    signer
        Command that reads bytes from standard input and writes their signature to standard output,
        for example with a smart card or token. Use it instead of --key.
    cert
        X.509 certificate (PEM) of the key.
    both
        Write both XML and PDF, with the same signature.
    """

    schema: Path | None = None
    key: Path | None = None
    signer: str | None = None
    cert: Path | None = None
    both: bool = False

    def check_output(self, output: Path) -> None:
        """Raise CounterspinError for an unsupported suffix, or if the file exists."""
        from counterspin.certificates.issuing import check_output_path, check_output_paths

        (check_output_paths if self.both else check_output_path)(output)

    def write(self, certificate: Certificate, output: Path, ledger: Path | None = None) -> None:
        """Write a certificate, and print its files and notes."""
        write_files = certificate.write_both if self.both else certificate.write
        written_paths = write_files(output, ledger=ledger)
        files_text = " and ".join(
            map(str, written_paths if isinstance(written_paths, list) else [written_paths])
        )
        names = f" of {', '.join(certificate.accelerometers)}" if certificate.accelerometers else ""
        print_output(f"Wrote {files_text}: certificate {certificate.identifier}{names}.")
        for note in certificate.notes:
            print_output(note)

    def signer_reader(self) -> Callable[[], Signer] | None:
        """Return a function that reads the key; None without a key."""
        from counterspin.certificates.signers import command_signer

        key, command, cert = self.key, self.signer, self.cert
        if command is not None and key is not None:
            raise UsageError("certificate", ["give --key or --signer, not both"])
        if command is not None:
            if cert is None:
                raise UsageError("certificate", ["give both --signer and --cert"])
            return lambda: command_signer(command, cert)
        if key is None:
            if cert is not None:
                raise UsageError("certificate", ["--cert: also give --key or --signer"])
            return None
        return lambda: _read_signer(key, cert)


def _read_signer(key: Path, cert: Path | None) -> Signer:
    """Read a key, and prompt for its password if it is encrypted."""
    from counterspin.certificates.signers import PasswordNeededError, read_signer

    try:
        return read_signer(key, cert)
    except PasswordNeededError:
        return read_signer(key, cert, _read_password(key))


def _read_password(key: Path) -> str:
    if sys.stdin is None:
        raise CampaignError(
            "certificate",
            [f"{key}: is encrypted; give its password on standard input"],
            code="password-needed",
        )
    make_prompts_interruptible()
    if sys.stdin.isatty():
        return getpass(f"Password of {key}: ")
    return sys.stdin.readline().rstrip("\r\n")


@option_group
@frozen
class IssueOptions:
    """Reasons stated in a certificate, and the ledger.

    Parameters
    ----------
    accept_misfit
        Reason for certifying a result that the records contradict; the certificate states it.
    accept_unsealed
        Reason for certifying a result without a seal; the certificate states it.
    amends
        Issued certificate (XML or PDF) that the new certificate replaces. With --verify: check that
        the certificate replaces this certificate.
    reason
        Reason for the replacement; the certificate states the reason and the changes.
    ledger
        Ledger in which to enter the certificate, instead of the ledger named in LAB.toml.
    """

    accept_misfit: str | None = None
    accept_unsealed: str | None = None
    amends: Path | None = None
    reason: str | None = None
    ledger: Path | None = None


NO_SIGNATURE = SigningOptions()
_DEFAULT_ISSUE = IssueOptions()

#: Status of the pages of a PDF -> statement.
_PAGE_STATEMENTS = {
    None: (
        "This statement applies only to the XML attached to the PDF. The visible pages were "
        "not checked."
    ),
    "none": (
        "This statement applies only to the XML attached to the PDF. The visible pages are not "
        "signed."
    ),
    "valid": "The pages bear a valid signature by the same signer.",
}


@command
def certificate(
    result: Path | None = None,
    lab: Path | None = None,
    /,
    *,
    output: OutputFile = None,
    signing_options: SigningOptions = NO_SIGNATURE,
    issue_options: IssueOptions = _DEFAULT_ISSUE,
    init: Path | None = None,
    verify: Path | None = None,
) -> None:
    """Write the Digital Calibration Certificate (DCC) of a result, or verify a certificate.

    Parameters
    ----------
    result
        Result written by `counterspin calibrate --json`.
    lab
        Laboratory data: LAB.toml.
    output
        Certificate file: .xml, or .pdf with the XML attached (PDF/A-3a).
    init
        Write a commented LAB.toml template to this file and exit.
    verify
        Check an existing certificate (XML or PDF), print its values and exit. With --cert, also
        check the signature.
    """
    from counterspin.certificates.amendment import Amendment
    from counterspin.certificates.issuing import certificate as issue_certificate
    from counterspin.certificates.issuing import certificate_blocks, check_certificate
    from counterspin.certificates.lab import write_example
    from counterspin.reports.text import Report, make_console

    if sum(argument is not None for argument in (result, init, verify)) != 1:
        raise UsageError(
            "certificate", ["give RESULT and LAB.toml, or --init LAB.toml, or --verify FILE"]
        )
    if init is not None:
        print_output(f"Wrote {write_example(init)}. Replace all example data in this file.")
        return
    if verify is not None:
        verification = check_certificate(
            verify,
            schema=signing_options.schema,
            signer_certificate=signing_options.cert,
            amended_path=issue_options.amends,
        )
        make_console().print(Report(list(certificate_blocks(verification.numbers))))
        signature_statements = {
            "none": "The document is not signed.",
            "unchecked": "The document is signed, but the signature was not checked. To check "
            "the signature, give --cert CERT.pem.",
            "valid": "The signature is valid.",
        }
        print_output("", signature_statements[verification.signature])
        if verification.expiry_date is not None:
            print_output(
                f"The signer's certificate expired on {verification.expiry_date}; it was valid "
                "on the day of issue stated in the document."
            )
        if (replaced_identifier := verification.numbers.amended_identifier) is not None:
            checksum_statement = (
                ", whose checksum is correct" if issue_options.amends is not None else ""
            )
            print_output(
                f"The document amends and replaces certificate {replaced_identifier}"
                f"{checksum_statement}."
            )
        if verify.suffix.lower() == ".pdf":
            print_output(_PAGE_STATEMENTS[verification.page_signature])
        return
    if result is None or lab is None or output is None:
        raise UsageError("certificate", ["give RESULT, LAB.toml, and -o FILE.xml or FILE.pdf"])
    if (issue_options.amends is None) != (issue_options.reason is None):
        raise UsageError("certificate", ["give both --amends OLD.xml and --reason WHY"])
    signing_options.check_output(output)
    issued_certificate = issue_certificate(
        result,
        lab,
        schema=signing_options.schema,
        signer=signing_options.signer_reader(),
        accept_misfit=issue_options.accept_misfit,
        accept_unsealed=issue_options.accept_unsealed,
        amends=None
        if issue_options.amends is None or issue_options.reason is None
        else Amendment(issue_options.amends, issue_options.reason),
    )
    signing_options.write(issued_certificate, output, issue_options.ledger)
