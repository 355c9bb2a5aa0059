// @ts-check
// The certificate of a result: a preview of its pages next to the laboratory data.

import { resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { CertificateForm, titleOf } from "./certificate_form.js";
import { labelled, make, oneAtATime, submitHandler, working } from "./dom.js";
import { guardUnsaved } from "./editor.js";
import { makeReceipt } from "./receipt.js";
import { Signing } from "./signing.js";
import { campaignTabs } from "./tabs.js";

/** The file of the certificate to be amended on the next page. */
let amendedFile = "";

/** The choice between a new certificate and an amendment, with the reason of the amendment. */
class Amendment {
  /**
   * @param {{file: string, identifier: string}[]} certificates issued certificates of the folder
   * @param {() => void} onChange
   */
  constructor(certificates, onChange) {
    this.file = make("select", {
      onchange: () => {
        this.show();
        onChange();
      },
    }, make("option", { value: "" }, "New certificate"),
    ...certificates.map(({ file, identifier }) => make("option", { value: file }, `Amendment to ${identifier}`)));
    this.reason = make("input", { autocomplete: "off", oninput: onChange });
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

  /** The amendment for a request; undefined for a new certificate. */
  get request() {
    return this.file.value ? { file: this.file.value, reason: this.reason.value.trim() } : undefined;
  }
}

/** The pages of a certificate as images. */
class Preview {
  constructor() {
    this.pageList = make("div", { class: "sheets", tabindex: "0", role: "region", "aria-label": "Certificate pages" });
    this.state = make("p", { class: "quiet", role: "status" }, "Rendering the pages.");
    this.errorBox = make("div");
    this.element = make("section", { class: "pages" }, make("h2", {}, "Preview"), this.state, this.errorBox, this.pageList);
  }

  /**
   * Show pages, with a text about them.
   * @param {string[]} pages SVG
   * @param {string} text
   */
  show(pages, text) {
    this.pageList.replaceChildren(...pages.map((page, index) => make("img", {
      src: `data:image/svg+xml;charset=utf-8,${encodeURIComponent(page)}`,
      alt: `Certificate page ${index + 1} of ${pages.length}`,
    })));
    this.state.textContent = text;
  }
}

/**
 * The campaign folder of a result, if there is one.
 * @param {import("./answers.js").FolderOverview} folder
 * @param {string} result
 */
const campaignOfResult = (folder, result) => {
  const name = result.includes("/") ? result.replace(/\/[^/]*$/, "") : "";
  return folder.campaigns.some((campaign) => campaign.name === name) ? name : undefined;
};

/**
 * The page of a result's certificate.
 * @param {string} result
 */
export async function certificateView(result) {
  const folder = await get("folder");
  const defaultFile = result.replace(/[^/]*$/, "LAB.toml");
  const file = folder.labs.includes(defaultFile) ? defaultFile : folder.labs[0] ?? defaultFile;
  const labData = await get("lab", { file, result });
  const preview = new Preview();
  const output = make("input", { required: true, autocomplete: "off" });
  const nameFile = () => {
    const suffix = amendment.request ? `-A${labData.certificates.length}` : "";
    output.value = result.replace(/(result)?\.json$/, `certificate${suffix}.xml`);
  };
  const amendment = new Amendment(labData.certificates, () => {
    nameFile();
    updateGaps();
  });
  nameFile();
  const bothFormats = make("input", { type: "checkbox", checked: true });
  const button = make("button", { class: "main" }, "Sign and issue");
  const container = make("div", { "aria-live": "polite" });
  const gapList = make("div", { class: "missing", id: "missing", role: "status" });

  /** Missing and invalid entries, with actions that correct them. */
  const findGaps = () => [
    ...form.gaps(),
    ...amendment.gap ? [{ section: "Amendment", text: "Reason for the amendment", words: "", go: () => amendment.reason.focus(), leaveOut: null }] : [],
    ...signing.gap ? [{ section: "Signature", text: signing.gap, words: "", go: () => signing.focus(), leaveOut: null }] : [],
  ];
  const updateGaps = () => {
    const gaps = findGaps();
    const isDraft = form.content.missing.length > 0 && !signing.isSigned && !form.content.problems.length;
    const isBlocked = gaps.length > 0 && !isDraft;
    button.textContent = signing.isSigned ? "Sign and issue" : isDraft ? "Write draft" : "Issue";
    if (isBlocked) button.setAttribute("aria-disabled", "true");
    else button.removeAttribute("aria-disabled");
    button.setAttribute("aria-describedby", gapList.id);
    gapList.className = gaps.length ? "missing" : "missing complete";
    const entryCount = gaps.length === 1 ? "one entry" : `${gaps.length} entries`;
    const action = signing.isSigned ? "sign" : "issue";
    const sections = new Map(gaps.map(({ section }) => [section, gaps.filter((gap) => gap.section === section)]));
    gapList.replaceChildren(make("h2", {}, gaps.length
      ? `Complete ${entryCount} before you ${action}${isDraft ? ". You can write a draft now" : ""}`
      : `All required entries are complete. Check the pages before you ${action}.`),
    ...gaps.length ? [make("ul", {}, ...[...sections].map(([section, sectionGaps]) =>
      make("li", {}, make("span", { class: "section" }, section), make("span", {}, ...sectionGaps.flatMap(({ text, words: help, go: focus, leaveOut }) => [
        make("button", { type: "button", class: "link", onclick: focus }, text),
        leaveOut ? make("button", { type: "button", class: "link", onclick: leaveOut, "aria-label": `Leave out ${text}` }, "(leave out)") : null,
        help ? make("span", { class: "help" }, help) : null])))))] : []);
  };
  let drawnText = "";
  let isIssued = false;
  const updatePreview = oneAtATime(async () => {
    const { text } = form.content;
    if (text === drawnText) return;
    if (form.content.problems.some(({ words: message }) => !message.includes("missing"))) {
      preview.state.textContent = "The preview does not show the latest entries, because an entry is not valid.";
      return;
    }
    preview.state.textContent = "Rendering the pages.";
    drawnText = text;
    const { pages } = await send("POST", "certificate-preview", { file, text, result });
    if (!isIssued) preview.show(pages, "Preview of the current entries. Every page is marked DRAFT until the certificate is issued.");
  }, preview.errorBox);

  const signing = new Signing(labData.signer, () => updateGaps());
  const form = new CertificateForm(labData, {
    result,
    shown: () => queueMicrotask(() => {
      updateGaps();
      updatePreview();
    }),
  });
  guardUnsaved(form);
  const entries = make("section", { class: "entries" });
  const issue = submitHandler(container, async () => {
    await form.pending;
    const [gap] = findGaps();
    if (button.getAttribute("aria-disabled")) {
      gap?.go();
      return;
    }
    if (form.isChanged || !form.version) await form.save();
    if (form.isChanged) return;
    container.replaceChildren(working(signing.isSigned ? "Signing" : "Writing"));
    button.disabled = true;
    try {
      const receipt = await send("POST", "certificate", {
        result, lab: file, output: output.value, both: bothFormats.checked, signing: await signing.request(), amends: amendment.request,
      });
      isIssued = true;
      const amend = () => {
        amendedFile = receipt.files.find((/** @type {string} */ name) => name.endsWith(".xml")) ?? "";
        dispatchEvent(new HashChangeEvent("hashchange"));
      };
      entries.replaceChildren(makeReceipt(receipt, { result, signed: signing.isSigned, form, amend }));
      preview.show(receipt.pages, receipt.draft ? "This is the certificate draft as written." : "This is the certificate as issued.");
      entries.querySelector("h2")?.focus();
    } finally {
      button.disabled = false;
    }
  });
  entries.append(
    gapList, form.messages, form.fields,
    make("details", { class: "aside" }, make("summary", {}, `${titleOf("file")}: ${file}`),
      labelled(`${file}, as text`, form.area), form.button),
    make("form", { class: "sign", novalidate: true, onsubmit: issue },
      amendment.element, signing.element,
      make("details", { class: "aside" }, make("summary", {}, "Certificate files"),
        make("div", { class: "row" },
          labelled("Certificate file (.xml or .pdf)", output),
          make("label", { class: "choice" }, bothFormats, "Write both XML and PDF"))),
      container, button));
  const campaign = campaignOfResult(folder, result);
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
