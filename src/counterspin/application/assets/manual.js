// @ts-check
// The documentation: pages, and links to them.

import { get } from "./api.js";
import { make } from "./dom.js";

/**
 * A link to a page in a new window, so that inputs are not lost; the window gets the key.
 * @param {string} text
 * @param {string} target the page, perhaps with a heading
 * @param {string} [subject] what it explains, where the words alone do not say it
 */
export const manualLink = (text, target, subject) => make("a", {
  href: `#/manual/${target}`, target: "_blank", rel: "opener", "aria-label": subject ? `${text} of ${subject}` : null,
}, text);

/**
 * A text with links to pages.
 * @param {string} text
 * @param {[string, string][]} links words in their order, and where they lead to
 * @returns {(Node|string)[]}
 */
export function linkedText(text, links) {
  /** @type {(Node|string)[]} */
  const pieces = [];
  for (const [linkText, target] of links) {
    const position = text.indexOf(linkText);
    pieces.push(text.slice(0, position), manualLink(linkText, target));
    text = text.slice(position + linkText.length);
  }
  return [...pieces, text];
}

/**
 * A page of the documentation, and a list of all pages.
 * @param {string} name
 * @param {string} [heading] where to begin
 */
export async function manualView(name, heading) {
  const { title, html, pages } = await get("manual", { name });
  const content = make("div", { class: "report manual" });
  // Rendered by the server, without HTML from the text.
  content.innerHTML = html;
  const list = make("nav", { class: "contents pages", "aria-label": "Documentation" },
    make("ol", {}, ...pages.map((/** @type {[string, string]} */ [pageName, pageTitle]) => make("li", {},
      make("a", { href: `#/manual/${pageName}`, "aria-current": pageName === name ? "page" : null }, pageTitle)))));
  return { title, content: [make("div", { class: "beside" }, content, list)], begin: heading };
}
