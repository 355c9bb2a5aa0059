// @ts-check
// Exports of a recorder, dragged in: what is guessed of them is said, what they do not say is asked.

import { campaignAddress } from "./addresses.js";
import { bring, send } from "./api.js";
import { labelled, make, say, warning } from "./dom.js";

/** What begins a campaign from files. */
export function exportsPart() {
  const folder = make("input", { required: true, autocomplete: "off", placeholder: "my-campaign" });
  const files = make("input", { type: "file", multiple: true, id: "exports" });
  const place = make("div", { "aria-live": "polite" });

  /** @param {string[]} names */
  const draft = async (names) => {
    const told = await send("POST", "draft", { names });
    /** @type {Record<string, HTMLInputElement | HTMLSelectElement>} */
    const answers = {};
    const asked = told.questions.map(/** @param {any} question */ (question) => {
      const control = question.choices.length
        ? make("select", {}, ...question.choices.map(/** @param {string} one */ (one) =>
          make("option", { value: one }, one)))
        : make("input", { placeholder: question.example, autocomplete: "off", required: true });
      answers[question.key] = control;
      return labelled(question.text, control);
    });
    const wrong = make("div");
    place.replaceChildren(
      make("h3", {}, "Guessed from the files"),
      make("ul", {}, ...told.statements.map(/** @param {string} one */ (one) => make("li", {}, one))),
      make("form", {
        onsubmit: async (/** @type {Event} */ event) => {
          event.preventDefault();
          const said = Object.fromEntries(Object.entries(answers).map(([key, one]) => [key, one.value]));
          try {
            const made = await send("POST", "drafted", { folder: folder.value, names, answers: said });
            say(`Wrote ${made.name}/campaign.toml.`);
            location.hash = campaignAddress(made.name);
          } catch (error) {
            wrong.replaceChildren(warning(/** @type {Error} */ (error).message));
          }
        },
      }, make("div", { class: "grid" }, ...asked), make("button", { class: "main" }, "Write the campaign")),
      wrong);
  };

  /** @param {File[]} some */
  const take = async (some) => {
    if (!some.length) return;
    if (!folder.value.trim()) {
      place.replaceChildren(warning("Enter a folder name first."));
      folder.focus();
      return;
    }
    try {
      const names = [];
      for (const file of some) {
        place.replaceChildren(make("p", { class: "quiet" }, `Bringing ${file.name}.`));
        names.push((await bring(`${folder.value.trim()}/${file.name}`, file)).name);
      }
      place.replaceChildren(make("p", { class: "quiet" }, "Looking at the files."));
      await draft(names);
    } catch (error) {
      place.replaceChildren(warning(/** @type {Error} */ (error).message));
    }
  };
  files.addEventListener("change", () => take([...files.files ?? []]));
  const zone = make("div", { class: "drop" },
    make("div", { class: "row" }, labelled("Folder of the new campaign", folder),
      labelled("The recorder's files, one for each run; or drag them here", files)), place);
  zone.addEventListener("dragover", (event) => {
    event.preventDefault();
    zone.classList.add("over");
  });
  zone.addEventListener("dragleave", () => zone.classList.remove("over"));
  zone.addEventListener("drop", (event) => {
    event.preventDefault();
    zone.classList.remove("over");
    take([...event.dataTransfer?.files ?? []]);
  });
  return zone;
}
