// @ts-check
// The certificate of a result: a preview of its pages beside the data that the laboratory states.

import { resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { CertificateForm, titleOf } from "./certificate_form.js";
import { labelled, make, oneAtATime, submitting, working } from "./dom.js";
import { guardUnsaved } from "./editor.js";
import { receiptOf } from "./receipt.js";
import { Signing } from "./signing.js";
import { campaignTabs } from "./tabs.js";

/** The file of the certificate that the next page is to amend. */
let amendedFile = "";

/** The choice between a new certificate and an amendment, with the reason of the amendment. */
class Amendment {
  /**
   * @param {{file: string, identifier: string}[]} certificates issued certificates of the folder
   * @param {() => void} changed
   */
  constructor(certificates, changed) {
    this.file = make("select", {
      onchange: () => {
        this.show();
        changed();
      },
    }, make("option", { value: "" }, "New certificate"),
    ...certificates.map(({ file, identifier }) => make("option", { value: file }, `Amendment to ${identifier}`)));
    this.reason = make("input", { autocomplete: "off", oninput: changed });
    this.row = labelled("Reason for the amendment", this.reason);
    this.element = make("div", { class: "row" }, labelled("Certificate type", this.file), this.row);
    this.element.hidden = !certificates.length;
    if (certificates.some(({ file }) => file === amendedFile)) this.file.value = amendedFile;
    amendedFile = "";
    this.show();
  }

  show() {
    this.row.hidden = !this.file.value;
  }

  /** Whether the reason is missing. */
  get gap() {
    return this.file.value !== "" && !this.reason.value.trim();
  }

  /** The amendment as a request states it; undefined for a new certificate. */
  get request() {
    return this.file.value ? { file: this.file.value, reason: this.reason.value.trim() } : undefined;
  }
}

/** The pages of a certificate as images. */
class Preview {
  constructor() {
    this.sheets = make("div", { class: "sheets", tabindex: "0", role: "region", "aria-label": "Certificate pages" });
    this.state = make("p", { class: "quiet", role: "status" }, "Rendering the pages.");
    this.wrong = make("div");
    this.element = make("section", { class: "pages" }, make("h2", {}, "Preview"), this.state, this.wrong, this.sheets);
  }

  /**
   * Show pages, with a text about them.
   * @param {string[]} pages SVG
   * @param {string} text
   */
  show(pages, text) {
    this.sheets.replaceChildren(...pages.map((page, place) => make("img", {
      src: `data:image/svg+xml;charset=utf-8,${encodeURIComponent(page)}`,
      alt: `Certificate page ${place + 1} of ${pages.length}`,
    })));
    this.state.textContent = text;
  }
}

/**
 * The folder of a result, if it is that of a campaign.
 * @param {import("./answers.js").FolderOverview} folder
 * @param {string} result
 */
const campaignOf = (folder, result) => {
  const name = result.includes("/") ? result.replace(/\/[^/]*$/, "") : "";
  return folder.campaigns.some((campaign) => campaign.name === name) ? name : undefined;
};

/**
 * The page of a result's certificate.
 * @param {string} result
 */
export async function certificateView(result) {
  const folder = await get("folder");
  const beside = result.replace(/[^/]*$/, "LAB.toml");
  const file = folder.labs.includes(beside) ? beside : folder.labs[0] ?? beside;
  const told = await get("lab", { file, result });
  const preview = new Preview();
  const output = make("input", { required: true, autocomplete: "off" });
  const nameFile = () => {
    const suffix = amendment.request ? `-A${told.certificates.length}` : "";
    output.value = result.replace(/(result)?\.json$/, `certificate${suffix}.xml`);
  };
  const amendment = new Amendment(told.certificates, () => {
    nameFile();
    judge();
  });
  nameFile();
  const both = make("input", { type: "checkbox", checked: true });
  const button = make("button", { class: "main" }, "Sign and issue");
  const place = make("div", { "aria-live": "polite" });
  const missing = make("div", { class: "missing", id: "missing", role: "status" });

  /** What prevents a signature, each with what is done about it. */
  const gaps = () => [
    ...form.gaps(),
    ...amendment.gap ? [{ section: "Amendment", text: "Reason for the amendment", words: "", go: () => amendment.reason.focus(), leaveOut: null }] : [],
    ...signing.gap ? [{ section: "Signature", text: signing.gap, words: "", go: () => signing.focus(), leaveOut: null }] : [],
  ];
  const judge = () => {
    const list = gaps();
    const draft = form.now.missing.length > 0 && !signing.wanted && !form.now.problems.length;
    const blocked = list.length > 0 && !draft;
    button.textContent = signing.wanted ? "Sign and issue" : draft ? "Write draft" : "Issue";
    if (blocked) button.setAttribute("aria-disabled", "true");
    else button.removeAttribute("aria-disabled");
    button.setAttribute("aria-describedby", missing.id);
    missing.className = list.length ? "missing" : "missing complete";
    const entries = list.length === 1 ? "one entry" : `${list.length} entries`;
    const action = signing.wanted ? "sign" : "issue";
    const sections = new Map(list.map(({ section }) => [section, list.filter((gap) => gap.section === section)]));
    missing.replaceChildren(make("h2", {}, list.length
      ? `Complete ${entries} before you ${action}${draft ? ". You can write a draft now" : ""}`
      : `All required entries are complete. Check the pages before you ${action}.`),
    ...list.length ? [make("ul", {}, ...[...sections].map(([section, some]) =>
      make("li", {}, make("span", { class: "section" }, section), make("span", {}, ...some.flatMap(({ text, words, go, leaveOut }) => [
        make("button", { type: "button", class: "link", onclick: go }, text),
        leaveOut ? make("button", { type: "button", class: "link", onclick: leaveOut, "aria-label": `Leave out ${text}` }, "(leave out)") : null,
        words ? make("span", { class: "help" }, words) : null])))))] : []);
  };
  let drawn = "";
  let issued = false;
  const draw = oneAtATime(async () => {
    const { text } = form.now;
    if (text === drawn) return;
    if (form.now.problems.some(({ words }) => !words.includes("missing"))) {
      preview.state.textContent = "The preview does not show the latest entries, because an entry is not valid.";
      return;
    }
    preview.state.textContent = "Rendering the pages.";
    drawn = text;
    const { pages } = await send("POST", "certificate-preview", { file, text, result });
    if (!issued) preview.show(pages, "Preview of the current entries. Every page is marked DRAFT until the certificate is issued.");
  }, preview.wrong);

  const signing = new Signing(told.signer, () => judge());
  const form = new CertificateForm(told, {
    result,
    shown: () => queueMicrotask(() => {
      judge();
      draw();
    }),
  });
  guardUnsaved(form);
  const entries = make("section", { class: "entries" });
  const issue = submitting(place, async () => {
    await form.last;
    const [gap] = gaps();
    if (button.getAttribute("aria-disabled")) {
      gap?.go();
      return;
    }
    if (form.changed || !form.version) await form.save();
    if (form.changed) return;
    place.replaceChildren(working(signing.wanted ? "Signing" : "Writing"));
    button.disabled = true;
    try {
      const made = await send("POST", "certificate", {
        result, lab: file, output: output.value, both: both.checked, signing: await signing.said(), amends: amendment.request,
      });
      issued = true;
      const amend = () => {
        amendedFile = made.files.find((/** @type {string} */ name) => name.endsWith(".xml")) ?? "";
        dispatchEvent(new HashChangeEvent("hashchange"));
      };
      entries.replaceChildren(receiptOf(made, { result, signed: signing.wanted, form, amend }));
      preview.show(made.pages, made.draft ? "This is the certificate draft as written." : "This is the certificate as issued.");
      entries.querySelector("h2")?.focus();
    } finally {
      button.disabled = false;
    }
  });
  entries.append(
    missing, form.notes, form.fields,
    make("details", { class: "aside" }, make("summary", {}, `${titleOf("file")}: ${file}`),
      labelled(`${file}, as text`, form.area), form.button),
    make("form", { class: "sign", novalidate: true, onsubmit: issue },
      amendment.element, signing.element,
      make("details", { class: "aside" }, make("summary", {}, "Certificate files"),
        make("div", { class: "row" },
          labelled("Certificate file (.xml or .pdf)", output),
          make("label", { class: "choice" }, both, "Write both XML and PDF"))),
      place, button));
  const campaign = campaignOf(folder, result);
  return {
    title: `Certificate for ${result}`,
    content: [
      make("div", { class: "head" }, make("div", {}, make("h1", {}, "Calibration certificate"),
        make("p", { class: "quiet" }, "Result: ", make("a", { href: resultAddress(result) }, result),
          ". The entries are stored in ", make("code", {}, file), "."))),
      ...campaign === undefined ? [] : [campaignTabs(campaign, "certificate", { step: "certify", result })],
      make("div", { class: "certify" }, preview.element, entries),
    ],
  };
}
