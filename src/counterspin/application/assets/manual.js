// @ts-check
// The documentation: its pages, and links to them from what they explain.

import { get } from "./api.js";
import { make } from "./dom.js";

/**
 * A link to a page in a window of its own, so that nothing typed is left; it takes the key along.
 * @param {string} words
 * @param {string} to the page, perhaps with a heading
 * @param {string} [of] what it explains, where the words alone do not say it
 */
export const manualLink = (words, to, of) => make("a", {
  href: `#/manual/${to}`, target: "_blank", rel: "opener", "aria-label": of ? `${words} of ${of}` : null,
}, words);

/**
 * A text in which some words lead to a page.
 * @param {string} text
 * @param {[string, string][]} links words in their order, and where they lead to
 * @returns {(Node|string)[]}
 */
export function linked(text, links) {
  /** @type {(Node|string)[]} */
  const pieces = [];
  for (const [words, to] of links) {
    const at = text.indexOf(words);
    pieces.push(text.slice(0, at), manualLink(words, to));
    text = text.slice(at + words.length);
  }
  return [...pieces, text];
}

/**
 * A page of the documentation, and a list of all.
 * @param {string} name
 * @param {string} [heading] where to begin
 */
export async function manualView(name, heading) {
  const { title, html, pages } = await get("manual", { name });
  const part = make("div", { class: "report manual" });
  // Our own, made without any HTML of its text.
  part.innerHTML = html;
  const list = make("nav", { class: "contents pages", "aria-label": "Documentation" },
    make("ol", {}, ...pages.map((/** @type {[string, string]} */ [one, words]) => make("li", {},
      make("a", { href: `#/manual/${one}`, "aria-current": one === name ? "page" : null }, words)))));
  return { title, content: [make("div", { class: "beside" }, part, list)], begin: heading };
}
