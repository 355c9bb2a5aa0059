// @ts-check
// A result: the report's own blocks.

import { get, getText, getTextNow, save } from "./api.js";
import { attempt, commandLine, make, say } from "./dom.js";
import { consistsOf, waysPart } from "./improving.js";
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
  // What can be zoomed is drawn here.
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
  place.replaceChildren(make("p", { class: "quiet" }, "Working."));
  return attempt(place, async () => {
    const { told, part } = await pagePart(kind, names, term);
    if (!part) {
      follow(told.job, place, () => fill(place, kind, names, term));
      return told;
    }
    part.querySelector("h1")?.remove();
    place.replaceChildren(part, commandLine(told.command));
    globalThis.counterspin.draw(part);
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

/** @param {string} name of a result */
export const certificateLink = (name) =>
  make("a", { class: "button", href: `#/certificate/${encodeURIComponent(name)}` }, "Certificate");

/**
 * The files that can be had of a result.
 * @param {string} name
 */
export const resultLinks = (name) => make("p", { class: "links" },
  ...["HTML", "PDF", "Markdown"].map((kind) => saving(`Report as ${kind}`, "report",
    { name, kind: kind === "Markdown" ? "md" : kind.toLowerCase() })),
  saving("Result as JSON", "file", { name }));

/**
 * The headings of a part, as links that go there.
 * @param {HTMLElement} part
 */
export function contents(part) {
  const headings = [...part.querySelectorAll("h2")].filter((one) => one.textContent?.trim());
  return make("nav", { class: "contents", "aria-label": "On this page" },
    make("p", { class: "quiet" }, "On this page"),
    make("ol", {}, ...headings.map((one) => make("li", {}, make("button", {
      type: "button",
      onclick: () => {
        one.tabIndex = -1;
        one.scrollIntoView();
        one.focus({ preventScroll: true });
      },
    }, one.textContent)))));
}

/**
 * Put what the uncertainty consists of, and what would reduce it, below the answer.
 * @param {HTMLElement} part
 * @param {string} result
 * @param {string[]} accelerometers
 * @param {string} [campaign] whose result it is
 */
export async function underAnswer(part, result, accelerometers, campaign) {
  const [consists, ways] = await Promise.all([
    consistsOf(result, accelerometers), campaign === undefined ? null : waysPart(campaign, result)]);
  const first = part.querySelector("h2");
  if (first) first.before(...(ways ? [ways] : []), ...consists);
}

/**
 * A result's page: what can be made of it above, its contents at the side.
 * @param {string} name
 * @param {HTMLElement} part
 */
export const withContents = (name, part) =>
  make("div", { class: "beside" }, make("div", {}, resultLinks(name), part), contents(part));

/**
 * The page of a result.
 * @param {string} name
 */
export async function resultView(name) {
  const { told, part } = await pagePart("result", [name]);
  part?.querySelector("h1")?.remove();
  if (part) await underAnswer(part, name, told.accelerometers);
  return {
    title: told.title,
    content: [
      make("div", { class: "head" }, make("h1", {}, told.title), make("div", { class: "row" }, certificateLink(name))),
      part ? withContents(name, part) : resultLinks(name),
      commandLine(told.command),
    ],
  };
}
