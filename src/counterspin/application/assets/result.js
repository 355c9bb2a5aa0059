// @ts-check
// A result: the report's own blocks.

import { get, getText } from "./api.js";
import { commandLine, make } from "./dom.js";

/**
 * Fetch the pictures of a page as they come near the screen.
 * @param {HTMLElement} part
 * @param {(place: string) => Promise<string>} picture
 */
export function fetchPictures(part, picture) {
  const near = new IntersectionObserver((seen) => {
    for (const { target, isIntersecting } of seen) {
      if (!isIntersecting) continue;
      near.unobserve(target);
      const box = /** @type {HTMLElement} */ (target);
      picture(box.dataset.place ?? "").then(
        (svg) => { box.innerHTML = svg; },
        (error) => { box.textContent = error.message; });
    }
  }, { rootMargin: "600px" });
  // What can be zoomed is drawn here.
  part.querySelectorAll("figure:not(.zoomable) .still[data-place]").forEach((box) => near.observe(box));
}

/**
 * The report of a result as a part of the page.
 * @param {string} name
 */
export async function resultPart(name) {
  const result = await get("result", { name });
  const part = make("div", { class: "report" });
  // Escaped by the report's own templates.
  part.innerHTML = result.html;
  part.querySelectorAll("a[href^='#at-']").forEach((link) => link.removeAttribute("href"));
  fetchPictures(part, (place) => getText("picture", { name, place }));
  return { result, part };
}

/**
 * The page of a result.
 * @param {string} name
 */
export async function resultView(name) {
  const { result, part } = await resultPart(name);
  return { title: result.title, content: [part, commandLine(result.command)] };
}
