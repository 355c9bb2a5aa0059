// @ts-check
// The page: routes and views.

import { RequestError, obtainKey } from "./api.js";
import { campaignView } from "./campaign.js";
import { certificateView } from "./certificate.js";
import { compareView, historyView } from "./compare.js";
import { descriptionView } from "./description.js";
import { hasUnsavedChanges } from "./editor.js";
import { folderView } from "./folder.js";
import { importView } from "./import.js";
import { make, warning } from "./dom.js";
import { liveView } from "./live.js";
import { planView, plansView } from "./plan.js";
import { resultView } from "./result.js";
import { manualView } from "./manual.js";
import { runsView } from "./runs.js";
import { tryView } from "./try.js";

/**
 * A route: its path, its name in the navigation, and its view.
 * @typedef {{path: RegExp, name?: string, address?: string,
 *   view: (...words: string[]) => Promise<{title: string, content: Node[], begin?: string}>}} Place
 */

/** @type {Place[]} */
const ROUTES = [
  { path: /^\/$/, name: "Campaigns", address: "#/", view: folderView },
  { path: /^\/plans$/, name: "Plans", address: "#/plans", view: plansView },
  { path: /^\/compare$/, name: "Compare", address: "#/compare", view: compareView },
  { path: /^\/history$/, name: "History", address: "#/history", view: historyView },
  { path: /^\/manual\/glossary$/, name: "Glossary", address: "#/manual/glossary", view: () => manualView("glossary") },
  { path: /^\/manual\/([^#]*)#?(.*)$/, name: "Help", address: "#/manual/application", view: manualView },
  { path: /^\/import$/, view: importView },
  { path: /^\/plan\/(.*)$/, view: planView },
  { path: /^\/live\/(.*)$/, view: liveView },
  { path: /^\/runs\/(.*)$/, view: runsView },
  { path: /^\/try\/(.*)$/, view: tryView },
  { path: /^\/certificate\/(.*)$/, view: certificateView },
  { path: /^\/campaign\/(.*)$/, view: campaignView },
  { path: /^\/description\/([^#]*)#?(.*)$/, view: descriptionView },
  { path: /^\/result\/(.*)$/, view: resultView },
];

const viewElement = /** @type {HTMLElement} */ (document.getElementById("view"));
const navigation = /** @type {HTMLElement} */ (document.getElementById("places"));
let viewNumber = 0;

/** @param {string} word of an address */
function decodeWord(word) {
  try {
    return decodeURIComponent(word);
  } catch {
    throw new Error("This page does not exist.");
  }
}

async function show() {
  const number = ++viewNumber;
  const path = location.hash.replace(/^#/, "") || "/";
  const route = ROUTES.map((candidate) => ({ place: candidate, match: candidate.path.exec(path) }))
    .find(({ match }) => match);
  navigation.replaceChildren(...ROUTES.filter(({ name }) => name).map(({ name, address }) =>
    make("a", { href: address, "aria-current": `#${path}` === address ? "page" : null }, name)));
  viewElement.setAttribute("aria-busy", "true");
  let title = "counterspin";
  /** @type {string | undefined} */
  let begin;
  /** @type {Node[]} */
  let content;
  try {
    if (!route) throw new Error("This page does not exist.");
    const parameters = /** @type {RegExpExecArray} */ (route.match).slice(1).map(decodeWord);
    ({ title, content, begin } = await route.place.view(...parameters));
  } catch (error) {
    const isUnauthorised = error instanceof RequestError && error.status === 401;
    content = [make("h1", {}, isUnauthorised ? "This window is not authorised" : "This page could not be loaded"),
      warning(/** @type {Error} */ (error).message)];
  }
  if (number !== viewNumber) return null;
  viewElement.replaceChildren(...content);
  viewElement.removeAttribute("aria-busy");
  document.title = `${title} – counterspin`;
  globalThis.counterspin.draw(viewElement);
  return { begin };
}

/** @param {string|undefined} id of a heading, a field or a section of what is shown */
function goTo(id) {
  const target = id ? document.getElementById(id) : null;
  for (let details = target?.closest("details"); details; details = details.parentElement?.closest("details")) details.open = true;
  target?.scrollIntoView({ behavior: "instant", block: target.matches("input") ? "center" : "start" });
  if (target?.matches("input")) target.focus();
}

let shownHash = location.hash;
addEventListener("hashchange", () => {
  // The link of the terminal was opened in this window.
  if (location.hash.startsWith("#token=")) location.reload();
  // Ignore links within a page.
  if (!location.hash.startsWith("#/")) return;
  if (location.hash !== shownHash && hasUnsavedChanges() && !confirm("Leave this page without saving?")) {
    history.replaceState(null, "", shownHash);
    return;
  }
  shownHash = location.hash;
  show().then((shown) => {
    // Do not scroll if the page was left before it was shown.
    if (!shown) return;
    viewElement.focus();
    scrollTo(0, 0);
    goTo(shown.begin);
  });
});
obtainKey().finally(() => { shownHash = location.hash; return show().then((shown) => goTo(shown?.begin)); });
