// @ts-check
// A result: cards with the main values, and chapters as tabs.

import { get, getText, getTextSync, saveFile } from "./api.js";
import { attempt, commandLine, make, say, stateMark, working } from "./dom.js";
import { addSliders, improvementsPart } from "./improving.js";
import { follow } from "./job.js";

/**
 * Load the pictures of a page when they come near the viewport, and all of them before printing.
 * @param {HTMLElement} report
 * @param {Record<string, any>} request the page
 */
function fetchPictures(report, request) {
  const observer = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting) continue;
      observer.unobserve(target);
      const box = /** @type {HTMLElement} */ (target);
      getText("picture", { ...request, place: box.dataset.place }).then(
        (svg) => { box.innerHTML = svg; },
        (error) => { box.textContent = error.message; });
    }
  }, { rootMargin: "600px" });
  // Zoomable plots are drawn in the page; their static pictures are loaded when they are saved.
  report.querySelectorAll(".still[data-place]").forEach((target) => {
    const box = /** @type {any} */ (target);
    box.fetchPicture = () => getText("picture", { ...request, place: box.dataset.place });
  });
  report.querySelectorAll("figure:not(.zoomable) .still[data-place]").forEach((box) => observer.observe(box));
  const beforePrint = () => {
    if (!report.isConnected) return removeEventListener("beforeprint", beforePrint);
    // Zoomable plots are static when printed.
    report.querySelectorAll(".still[data-place]:empty").forEach((target) => {
      const box = /** @type {HTMLElement} */ (target);
      box.innerHTML = getTextSync("picture", { ...request, place: box.dataset.place ?? "" });
    });
  };
  addEventListener("beforeprint", beforePrint);
}

/**
 * The HTML of a page of blocks; null while a job computes it.
 * @param {string} kind
 * @param {string[]} names
 * @param {string} [term]
 */
export async function pagePart(kind, names, term) {
  const request = { kind, names: names.join("\n"), ...term === undefined ? {} : { term } };
  const page = await get("page", request);
  if (page.job) return { told: page, part: null };
  const report = make("div", { class: "report" });
  // Escaped by the report's own templates.
  report.innerHTML = page.html;
  fetchPictures(report, request);
  return { told: page, part: report };
}

/**
 * Show a page of blocks in a container, or an error; return the page.
 * @param {HTMLElement} container
 * @param {string} kind
 * @param {string[]} names
 * @param {string} [term]
 */
export async function fillContainer(container, kind, names, term) {
  const notice = working("Calculating");
  container.replaceChildren(notice);
  // A later call replaces the notice; the response to an earlier call is then ignored.
  const isCurrent = () => notice.parentNode === container;
  return attempt(container, async () => {
    const answer = await pagePart(kind, names, term).catch((error) => {
      if (isCurrent()) throw error;
    });
    if (!answer || !isCurrent()) return undefined;
    const { told: page, part: report } = answer;
    if (page.job) {
      follow(page.job, container, () => fillContainer(container, kind, names, term));
      return page;
    }
    report?.querySelector("h1")?.remove();
    container.replaceChildren(report ?? "", commandLine(page.command));
    if (report) globalThis.counterspin.draw(report);
    return page;
  });
}

/**
 * A button that downloads a file.
 * @param {string} label
 * @param {"report" | "file"} name
 * @param {Record<string, string>} parameters
 */
export const saveButton = (label, name, parameters) => make("button", {
  type: "button",
  onclick: () => saveFile(name, parameters).catch((error) => say(error.message)),
}, label);

/**
 * The link to the certificate of a result, or a button that states why none can be issued.
 * @param {string} name
 * @param {string} refusal why no certificate can be issued; empty if one can
 */
const certificateLink = (name, refusal) => (refusal
  ? make("button", { type: "button", "aria-disabled": "true", title: refusal, onclick: () => say(refusal) }, "Certify")
  : make("a", { class: "button main", href: `#/certificate/${encodeURIComponent(name)}` }, "Certify"));

/**
 * A menu of the files of a result.
 * @param {string} name
 */
export const reportMenu = (name) => make("details", { class: "menu" }, make("summary", {}, "Report"),
  make("div", {},
    ...["HTML", "PDF", "Markdown"].map((kind) => saveButton(`Report as ${kind}`, "report",
      { name, kind: kind === "Markdown" ? "md" : kind.toLowerCase() })),
    saveButton("Result as JSON", "file", { name })));

/**
 * A button that copies the values on the cards.
 * @param {HTMLElement} report
 */
const copyButton = (report) => make("button", {
  type: "button",
  onclick: () => {
    const lines = [...report.querySelectorAll(".instrument")].map((card) =>
      [card.querySelector("h2"), ...card.querySelectorAll(".value, .halves p:not(.value)")]
        .map((element) => element?.textContent?.trim()).join("\t"));
    navigator.clipboard.writeText(lines.join("\n"))
      .then(() => say("Result copied."), () => say("The browser denied access to the clipboard, so the result was not copied. Select and copy the values, or save the report."));
  },
}, "Copy result");

/**
 * The view of a result: title, state and actions, then cards and tabs.
 * @param {{title: string, name: string, told: import("./answers.js").PageContent, part: HTMLElement | null, state: Node,
 *   actions?: (Node | null)[], steps?: Node, campaign?: string}} shown
 */
export async function dashboard({ title, name, told: page, part: report, state, actions = [], steps, campaign }) {
  report?.querySelector("h1")?.remove();
  if (report) {
    const improvements = campaign === undefined ? null : improvementsPart(campaign, name);
    await Promise.all(page.accelerometers.map((/** @type {string} */ accelerometer) => addSliders(report, name, accelerometer)));
    const improvementsSection = await improvements;
    // After the uncertainty budgets.
    if (improvementsSection) report.querySelector("#at-uncertainty-budget")?.parentElement?.append(improvementsSection);
  }
  const buttons = report
    ? [reportMenu(name), copyButton(report), certificateLink(name, page.refusal)] : [reportMenu(name)];
  return make("div", { class: "dashboard" },
    make("div", { class: "head" },
      make("div", {}, make("h1", {}, title, " ", state), campaign ? make("p", { class: "quiet" }, `Folder ${campaign}`) : null),
      make("div", { class: "row" }, ...actions, ...buttons)),
    ...(steps ? [steps] : []), ...(report ? [report] : []));
}

/**
 * The page of a result.
 * @param {string} name
 */
export async function resultView(name) {
  const { told: page, part: report } = await pagePart("result", [name]);
  const state = stateMark(page.state, page.words);
  return {
    title: page.title,
    content: [
      await dashboard({ title: page.title, name, told: page, part: report, state }),
      commandLine(page.command),
    ],
  };
}
