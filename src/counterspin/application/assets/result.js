// @ts-check
// A result on one screen: the answer on cards, its chapters as tabs.

import { get, getText, getTextNow, save } from "./api.js";
import { attempt, commandLine, make, say, stateMark, working } from "./dom.js";
import { addSliders, waysPart } from "./improving.js";
import { follow } from "./job.js";

/**
 * Fetch the pictures of a page as they come near the screen, and all of them before it is printed.
 * @param {HTMLElement} part
 * @param {Record<string, any>} asked the page
 */
function fetchPictures(part, asked) {
  const near = new IntersectionObserver((seen) => {
    for (const { target, isIntersecting } of seen) {
      if (!isIntersecting) continue;
      near.unobserve(target);
      const box = /** @type {HTMLElement} */ (target);
      getText("picture", { ...asked, place: box.dataset.place }).then(
        (svg) => { box.innerHTML = svg; },
        (error) => { box.textContent = error.message; });
    }
  }, { rootMargin: "600px" });
  // What can be zoomed is drawn here; its still picture is fetched when it is saved.
  part.querySelectorAll(".still[data-place]").forEach((target) => {
    const box = /** @type {any} */ (target);
    box.fetchPicture = () => getText("picture", { ...asked, place: box.dataset.place });
  });
  part.querySelectorAll("figure:not(.zoomable) .still[data-place]").forEach((box) => near.observe(box));
  const beforePrint = () => {
    if (!part.isConnected) return removeEventListener("beforeprint", beforePrint);
    // Those that can be zoomed are still on paper.
    part.querySelectorAll(".still[data-place]:empty").forEach((target) => {
      const box = /** @type {HTMLElement} */ (target);
      box.innerHTML = getTextNow("picture", { ...asked, place: box.dataset.place ?? "" });
    });
  };
  addEventListener("beforeprint", beforePrint);
}

/**
 * A page of blocks as a part of this page; none while a job makes it.
 * @param {string} kind
 * @param {string[]} names
 * @param {string} [term]
 */
export async function pagePart(kind, names, term) {
  const asked = { kind, names: names.join("\n"), ...term === undefined ? {} : { term } };
  const told = await get("page", asked);
  if (told.job) return { told, part: null };
  const part = make("div", { class: "report" });
  // Escaped by the report's own templates.
  part.innerHTML = told.html;
  fetchPictures(part, asked);
  return { told, part };
}

/**
 * Draw a part into a place, or say why not; return what was told of it.
 * @param {HTMLElement} place
 * @param {string} kind
 * @param {string[]} names
 * @param {string} [term]
 */
export async function fill(place, kind, names, term) {
  const waiting = working("Calculating");
  place.replaceChildren(waiting);
  // A later call replaces the notice; the answer to an earlier one is then dropped.
  const isCurrent = () => waiting.parentNode === place;
  return attempt(place, async () => {
    const answer = await pagePart(kind, names, term).catch((error) => {
      if (isCurrent()) throw error;
    });
    if (!answer || !isCurrent()) return undefined;
    const { told, part } = answer;
    if (told.job) {
      follow(told.job, place, () => fill(place, kind, names, term));
      return told;
    }
    part?.querySelector("h1")?.remove();
    place.replaceChildren(part ?? "", commandLine(told.command));
    if (part) globalThis.counterspin.draw(part);
    return told;
  });
}

/**
 * A button that has the browser save a file.
 * @param {string} words
 * @param {"report" | "file"} name
 * @param {Record<string, string>} said
 */
export const saving = (words, name, said) => make("button", {
  type: "button",
  onclick: () => save(name, said).catch((error) => say(error.message)),
}, words);

/**
 * The link to the certificate of a result; a button that says why, if there can be none.
 * @param {string} name
 * @param {string} refusal why no certificate can be issued; empty if one can
 */
const certificateLink = (name, refusal) => (refusal
  ? make("button", { type: "button", "aria-disabled": "true", title: refusal, onclick: () => say(refusal) }, "Certify")
  : make("a", { class: "button main", href: `#/certificate/${encodeURIComponent(name)}` }, "Certify"));

/**
 * The files that can be had of a result, as a menu.
 * @param {string} name
 */
export const reportMenu = (name) => make("details", { class: "menu" }, make("summary", {}, "Report"),
  make("div", {},
    ...["HTML", "PDF", "Markdown"].map((kind) => saving(`Report as ${kind}`, "report",
      { name, kind: kind === "Markdown" ? "md" : kind.toLowerCase() })),
    saving("Result as JSON", "file", { name })));

/**
 * A button that copies the values on the cards.
 * @param {HTMLElement} part
 */
const copyButton = (part) => make("button", {
  type: "button",
  onclick: () => {
    const lines = [...part.querySelectorAll(".instrument")].map((card) =>
      [card.querySelector("h2"), ...card.querySelectorAll(".value, .halves p:not(.value)")]
        .map((element) => element?.textContent?.trim()).join("\t"));
    navigator.clipboard.writeText(lines.join("\n"))
      .then(() => say("Result copied."), () => say("The browser denied access to the clipboard, so the result was not copied. Select and copy the values, or save the report."));
  },
}, "Copy result");

/**
 * The screen of a result: title, state and actions above, then cards and tabs.
 * @param {{title: string, name: string, told: import("./answers.js").PageContent, part: HTMLElement | null, state: Node,
 *   actions?: (Node | null)[], steps?: Node, campaign?: string}} shown
 */
export async function dashboard({ title, name, told, part, state, actions = [], steps, campaign }) {
  part?.querySelector("h1")?.remove();
  if (part) {
    const ways = campaign === undefined ? null : waysPart(campaign, name);
    await Promise.all(told.accelerometers.map((/** @type {string} */ one) => addSliders(part, name, one)));
    const found = await ways;
    // Behind the budgets, which they would change.
    if (found) part.querySelector("#at-uncertainty-budget")?.parentElement?.append(found);
  }
  const buttons = part
    ? [reportMenu(name), copyButton(part), certificateLink(name, told.refusal)] : [reportMenu(name)];
  return make("div", { class: "dashboard" },
    make("div", { class: "head" },
      make("div", {}, make("h1", {}, title, " ", state), campaign ? make("p", { class: "quiet" }, `Folder ${campaign}`) : null),
      make("div", { class: "row" }, ...actions, ...buttons)),
    ...(steps ? [steps] : []), ...(part ? [part] : []));
}

/**
 * The page of a result.
 * @param {string} name
 */
export async function resultView(name) {
  const { told, part } = await pagePart("result", [name]);
  const state = stateMark(told.state, told.words);
  return {
    title: told.title,
    content: [
      await dashboard({ title: told.title, name, told, part, state }),
      commandLine(told.command),
    ],
  };
}
