// @ts-check
// The certificate of a result: the laboratory's data as a form, and the button that issues it.

import { resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { commandLine, labelled, make, say, warning } from "./dom.js";
import { editorOf } from "./editor.js";
import { saving } from "./result.js";

/**
 * The page of a result's certificate.
 * @param {string} result
 */
export async function certificateView(result) {
  const folder = await get("folder");
  const file = folder.labs[0] ?? "LAB.toml";
  const told = await get("lab", { file, result });
  const editor = editorOf(told, { result });
  const output = make("input", {
    value: result.replace(/(result)?\.json$/, "certificate.xml"), required: true, autocomplete: "off",
  });
  const place = make("div", { "aria-live": "polite" });
  const issue = async (/** @type {Event} */ event) => {
    event.preventDefault();
    if (editor.changed || !editor.version) await editor.save();
    if (editor.changed) return;
    try {
      const made = await send("POST", "certificate", { result, lab: file, output: output.value });
      say(`Wrote ${made.file}.`);
      place.replaceChildren(
        make("p", { class: "answer-line" },
          `Certificate ${made.identifier} of ${made.accelerometers.join(", ")}: `,
          saving(made.file, "file", { name: made.file })),
        ...made.notes.map(/** @param {string} note */ (note) => make("p", { class: "warning" }, note)),
        commandLine(made.command));
    } catch (error) {
      place.replaceChildren(warning(/** @type {Error} */ (error).message));
    }
  };
  return {
    title: `Certificate of ${result}`,
    content: [
      make("h1", {}, "Digital Calibration Certificate"),
      make("p", {}, "Of ", make("a", { href: resultAddress(result) }, result),
        ". The laboratory's data are kept in ", make("code", {}, file),
        told.version ? "." : ", which is not there yet: all of it is an example."),
      make("form", { class: "row", onsubmit: issue },
        labelled("File of the certificate, .xml or .pdf", output),
        make("button", { class: "main" }, "Issue")),
      place,
      editor.element,
    ],
  };
}
