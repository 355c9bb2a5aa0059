// @ts-check
// The receipt of a certificate that has been written: identifier, checksums, files, verification.

import { resultAddress } from "./addresses.js";
import { send } from "./api.js";
import { attempt, commandLine, make, warning, working } from "./dom.js";
import { saving } from "./result.js";

/**
 * The receipt.
 * @param {import("./answers.js").Receipt} made
 * @param {{result: string, signed: boolean, form: import("./certificate_form.js").CertificateForm, amend: () => void}} about
 */
export function receiptOf(made, { result, signed, form, amend }) {
  const pem = made.signer_certificate;
  const state = made.draft ? "Draft" : "Certificate";
  const facts = [
    ["Identifier", made.identifier],
    ["Accelerometers", made.accelerometers.join(", ")],
    ["Responsible person", made.signed_by],
    ["Signature", signed ? `electronic (${made.signer})` : "none"],
  ];
  const files = made.files.map((/** @type {string} */ name, /** @type {number} */ place) =>
    fileBox(name, made.checksums[place], pem));
  return make("div", { class: "receipt" },
    make("h2", { tabindex: "-1" }, `${state} ${made.identifier} ${made.draft ? "written" : signed ? "signed and issued" : "issued"}`),
    make("dl", {}, ...facts.flatMap(([term, text]) => [make("dt", {}, term), make("dd", {}, text)])),
    ...made.notes.map((/** @type {string} */ note) => make("p", { class: "warning" }, note)),
    ...files,
    pem ? make("p", { class: "help" }, "To verify the signature, the recipient needs the signer’s certificate. Send it separately: ",
      make("a", { href: `data:application/x-pem-file;base64,${btoa(pem)}`, download: "signer.pem" }, "signer.pem"), ".") : null,
    make("div", { class: "row" },
      form.hasProfile || made.draft ? null : form.profileButton(),
      made.draft || !made.files.some((/** @type {string} */ name) => name.endsWith(".xml")) ? null
        : make("button", { type: "button", onclick: amend }, "Amend"),
      make("a", { class: "button", href: resultAddress(result) }, "Back to the result")),
    commandLine(made.command));
}

/**
 * A written file with its checksum, and buttons to save and to verify it.
 * @param {string} name
 * @param {string} checksum
 * @param {string | null} pem certificate of the signer
 */
function fileBox(name, checksum, pem) {
  const state = make("p", { role: "status" });
  const save = saving("Save", "file", { name });
  save.setAttribute("aria-label", `Save ${name}`);
  const verify = () => attempt(state, async () => {
    state.replaceChildren(working("Verifying"));
    const told = await send("POST", "certificate-check", {
      name, ...pem ? { certificate: { name: "signer.pem", content: btoa(pem) } } : {},
    });
    if (told.checksum !== checksum) {
      state.replaceChildren(warning("The file has changed since it was written."));
      return;
    }
    state.replaceChildren(make("span", { class: "state good" }, {
      valid: told.pages ? "The signatures of the XML and the pages are valid" : "The signature is valid",
      none: "Unchanged; not signed",
      unchecked: "Unchanged; the signature was not verified",
    }[/** @type {"valid" | "none" | "unchecked"} */ (told.signature)]));
  });
  return make("div", { class: "card" },
    make("div", { class: "row" }, make("strong", {}, name), save,
      make("button", { type: "button", onclick: verify, "aria-label": `Verify ${name}` }, "Verify")),
    make("p", { class: "help" }, "SHA-256 ", make("code", {}, checksum)),
    state);
}
