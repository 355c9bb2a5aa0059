// @ts-check
// The page: which view stands at which place.

import { Refused, enter } from "./api.js";
import { campaignView } from "./campaign.js";
import { certificateView } from "./certificate.js";
import { compareView, historyView } from "./compare.js";
import { descriptionView } from "./description.js";
import { unsaved } from "./editor.js";
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
 * A place: its address, its name in the list of places, and what is shown there.
 * @typedef {{path: RegExp, name?: string, address?: string,
 *   view: (...words: string[]) => Promise<{title: string, content: Node[], begin?: string}>}} Place
 */

/** @type {Place[]} */
const PLACES = [
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

const main = /** @type {HTMLElement} */ (document.getElementById("view"));
const places = /** @type {HTMLElement} */ (document.getElementById("places"));
let turn = 0;

async function show() {
  const mine = ++turn;
  const path = location.hash.replace(/^#/, "") || "/";
  const found = PLACES.map((place) => ({ place, match: place.path.exec(path) }))
    .find(({ match }) => match);
  places.replaceChildren(...PLACES.filter(({ name }) => name).map(({ name, address }) =>
    make("a", { href: address, "aria-current": `#${path}` === address ? "page" : null }, name)));
  main.setAttribute("aria-busy", "true");
  let title = "counterspin";
  /** @type {string | undefined} */
  let begin;
  /** @type {Node[]} */
  let content;
  try {
    if (!found) throw new Error("This page does not exist.");
    const words = /** @type {RegExpExecArray} */ (found.match).slice(1).map(decodeURIComponent);
    ({ title, content, begin } = await found.place.view(...words));
  } catch (error) {
    const keyless = error instanceof Refused && error.status === 401;
    content = [make("h1", {}, keyless ? "This window is not authorised" : "This page could not be loaded"),
      warning(/** @type {Error} */ (error).message)];
  }
  if (mine !== turn) return null;
  main.replaceChildren(...content);
  main.removeAttribute("aria-busy");
  document.title = `${title} – counterspin`;
  globalThis.counterspin.draw(main);
  return { begin };
}

/** @param {string|undefined} id of a heading, a field or a section of what is shown */
function goTo(id) {
  const found = id ? document.getElementById(id) : null;
  for (let one = found?.closest("details"); one; one = one.parentElement?.closest("details")) one.open = true;
  found?.scrollIntoView({ behavior: "instant", block: found.matches("input") ? "center" : "start" });
  if (found?.matches("input")) found.focus();
}

let shownAt = location.hash;
addEventListener("hashchange", () => {
  // A link of the terminal, opened in this window.
  if (location.hash.startsWith("#token=")) location.reload();
  // A link within a page is none to another place.
  if (!location.hash.startsWith("#/")) return;
  if (location.hash !== shownAt && unsaved() && !confirm("Leave this page without saving?")) {
    history.replaceState(null, "", shownAt);
    return;
  }
  shownAt = location.hash;
  show().then((shown) => {
    // A page that was left before it was shown moves nothing.
    if (!shown) return;
    main.focus();
    scrollTo(0, 0);
    goTo(shown.begin);
  });
});
enter().finally(() => { shownAt = location.hash; return show().then((shown) => goTo(shown?.begin)); });
