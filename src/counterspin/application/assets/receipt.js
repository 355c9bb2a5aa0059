// @ts-check
// The receipt of a certificate that has been written: identifier, checksums, files, verification.

import { resultAddress } from "./addresses.js";
import { send } from "./api.js";
import { attempt, commandLine, make, warning, working } from "./dom.js";
import { saveButton } from "./result.js";

/**
 * The receipt.
 * @param {import("./answers.js").Receipt} receipt
 * @param {{result: string, signed: boolean, form: import("./certificate_form.js").CertificateForm, amend: () => void}} about
 */
export function makeReceipt(receipt, { result, signed: isSigned, form, amend }) {
  const pem = receipt.signer_certificate;
  const documentType = receipt.draft ? "Draft" : "Certificate";
  const properties = [
    ["Identifier", receipt.identifier],
    ["Accelerometers", receipt.accelerometers.join(", ")],
    ["Responsible person", receipt.signed_by],
    ["Signature", isSigned ? `electronic (${receipt.signer})` : "none"],
  ];
  const files = receipt.files.map((/** @type {string} */ name, /** @type {number} */ index) =>
    fileBox(name, receipt.checksums[index], pem));
  return make("div", { class: "receipt" },
    make("h2", { tabindex: "-1" }, `${documentType} ${receipt.identifier} ${receipt.draft ? "written" : isSigned ? "signed and issued" : "issued"}`),
    make("dl", {}, ...properties.flatMap(([term, text]) => [make("dt", {}, term), make("dd", {}, text)])),
    ...receipt.notes.map((/** @type {string} */ remark) => make("p", { class: "warning" }, remark)),
    ...files,
    pem ? make("p", { class: "help" }, "To verify the signature, the recipient needs the signer’s certificate. Send it separately: ",
      make("a", { href: `data:application/x-pem-file;base64,${btoa(pem)}`, download: "signer.pem" }, "signer.pem"), ".") : null,
    make("div", { class: "row" },
      form.hasProfile || receipt.draft ? null : form.profileButton(),
      receipt.draft || !receipt.files.some((/** @type {string} */ name) => name.endsWith(".xml")) ? null
        : make("button", { type: "button", onclick: amend }, "Amend"),
      make("a", { class: "button", href: resultAddress(result) }, "Back to the result")),
    commandLine(receipt.command));
}

/**
 * A written file with its checksum, and buttons to save and to verify it.
 * @param {string} name
 * @param {string} checksum
 * @param {string | null} pem certificate of the signer
 */
function fileBox(name, checksum, pem) {
  const status = make("p", { role: "status" });
  const save = saveButton("Save", "file", { name });
  save.setAttribute("aria-label", `Save ${name}`);
  const verify = () => attempt(status, async () => {
    status.replaceChildren(working("Verifying"));
    const response = await send("POST", "certificate-check", {
      name, ...pem ? { certificate: { name: "signer.pem", content: btoa(pem) } } : {},
    });
    if (response.checksum !== checksum) {
      status.replaceChildren(warning("The file has changed since it was written."));
      return;
    }
    status.replaceChildren(make("span", { class: "state good" }, {
      valid: response.pages ? "The signatures of the XML and the pages are valid" : "The signature is valid",
      none: "Unchanged; not signed",
      unchecked: "Unchanged; the signature was not verified",
    }[/** @type {"valid" | "none" | "unchecked"} */ (response.signature)]));
  });
  return make("div", { class: "card" },
    make("div", { class: "row" }, make("strong", {}, name), save,
      make("button", { type: "button", onclick: verify, "aria-label": `Verify ${name}` }, "Verify")),
    make("p", { class: "help" }, "SHA-256 ", make("code", {}, checksum)),
    status);
}
