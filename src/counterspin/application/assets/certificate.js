// @ts-check
// The certificate of a result: the laboratory's data as a form, and the button that issues it.

import { resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { commandLine, inSections, labelled, make, say, submitting } from "./dom.js";
import { editorOf } from "./editor.js";
import { saving } from "./result.js";
import { Signing } from "./signing.js";

/**
 * The page of a result's certificate.
 * @param {string} result
 */
export async function certificateView(result) {
  const folder = await get("folder");
  const file = folder.labs[0] ?? "LAB.toml";
  const told = await get("lab", { file, result });
  const output = make("input", {
    value: result.replace(/(result)?\.json$/, "certificate.xml"), required: true, autocomplete: "off",
  });
  const both = make("input", { type: "checkbox", checked: true });
  const button = make("button", { class: "main" }, "Issue");
  const place = make("div", { "aria-live": "polite" });
  const draft = make("p", { id: "draft" });
  /** @type {{key: string, words: string}[]} */
  let missing = told.missing;
  // A draft, which lacks data, cannot be signed.
  const judge = () => {
    const refused = signing.wanted && missing.length > 0;
    button.disabled = refused;
    button.textContent = signing.wanted ? "Sign and issue" : "Issue";
    if (refused) button.setAttribute("aria-describedby", draft.id);
    else button.removeAttribute("aria-describedby");
    draft.className = refused ? "warning" : "quiet";
    draft.hidden = missing.length === 0;
    draft.textContent = `Missing, or a value of the template: ${inSections(missing.map(({ key }) => key))}. ${
      refused ? "Complete this before you sign." : "A certificate issued now is a draft, and every page says so."}`;
  };
  const signing = new Signing(told.signer, () => judge());
  const editor = editorOf(told, {
    result,
    shown: (now) => {
      missing = now.missing;
      judge();
    },
  });
  const issue = submitting(place, async () => {
    if (editor.changed || !editor.version) await editor.save();
    if (editor.changed || button.disabled) return;
    const made = await send("POST", "certificate", {
      result, lab: file, output: output.value, both: both.checked, signing: await signing.said(),
    });
    say(`Wrote ${made.files.join(" and ")}.`);
    place.replaceChildren(
      make("p", { class: "answer-line" },
        `Certificate ${made.identifier} of ${made.accelerometers.join(", ")}${signing.wanted ? ", signed" : ""}: `,
        ...made.files.map(/** @param {string} name */ (name) => saving(name, "file", { name }))),
      ...made.notes.map(/** @param {string} note */ (note) => make("p", { class: "warning" }, note)),
      commandLine(made.command));
  });
  return {
    title: `Certificate of ${result}`,
    content: [
      make("h1", {}, "Digital Calibration Certificate"),
      make("p", {}, "Of ", make("a", { href: resultAddress(result) }, result),
        ". The laboratory's data are kept in ", make("code", {}, file),
        told.version ? "." : ", which does not exist yet; the data shown are an example."),
      make("form", { onsubmit: issue },
        make("div", { class: "row" },
          labelled("File of the certificate, .xml or .pdf", output),
          make("label", { class: "choice" }, both, "XML and PDF, both")),
        signing.element,
        draft,
        button),
      place,
      editor.element,
    ],
  };
}
