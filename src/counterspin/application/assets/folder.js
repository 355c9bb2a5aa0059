// @ts-check
// The folder: campaigns with their states, and new campaigns.

import { campaignAddress, resultAddress } from "./addresses.js";
import { get, send } from "./api.js";
import { importEntry } from "./import.js";
import { attempt, labelled, make, say, stateMark, submitHandler, setSymbols, working } from "./dom.js";
import { pagePart } from "./result.js";
import { keepImport } from "./unfinished.js";

/** @typedef {import("./answers.js").CampaignEntry} CampaignEntry */

/**
 * A result in a few lines.
 * @param {import("./answers.js").ResultEntry} result
 */
export const resultLines = (result) => [
  ...(result.answers ?? []).map(({ name, text }) =>
    make("p", { class: "answer-line" }, ...setSymbols(`${name} = ${text}`))),
  make("p", {}, stateMark(result.state, result.words), " ",
    make("a", { href: resultAddress(result.name) }, result.name)),
];

/** @param {CampaignEntry} campaign */
function campaignCard(campaign) {
  const result = campaign.results[0];
  const summary = [
    campaign.instruments.join(", "),
    campaign.runs ? `${campaign.runs} run${campaign.runs === 1 ? "" : "s"}` : "",
    campaign.name,
  ].filter(Boolean).join(" · ");
  return make("li", { class: "card line" },
    make("div", {}, make("h2", {}, make("a", { href: campaignAddress(campaign.name) }, campaign.title)),
      make("p", { class: "quiet" }, summary)),
    make("div", {}, ...(result?.answers ?? []).map((answer) =>
      make("p", { class: "answer-line" }, ...setSymbols(`${answer.name} = ${answer.text}`))),
    make("p", {}, stateMark(campaign.state, campaign.words),
      campaign.missing.length ? ` Missing files: ${campaign.missing.length}` : "",
      campaign.mistakes.length ? ` Mistakes: ${campaign.mistakes.length}` : "")));
}

/** Sort order -> sort key of a campaign. */
const SORT_KEYS = {
  "name": (/** @type {CampaignEntry} */ campaign) => campaign.name,
  "title": (/** @type {CampaignEntry} */ campaign) => campaign.title,
  "newest result": (/** @type {CampaignEntry} */ campaign) => -(campaign.results[0]?.written ?? 0),
  "state": (/** @type {CampaignEntry} */ campaign) => campaign.words,
};

/**
 * The campaigns, with a search.
 * @param {CampaignEntry[]} campaigns
 */
function campaignList(campaigns) {
  const cards = campaigns.map((campaign) => ({ campaign, card: campaignCard(campaign) }));
  const list = make("ul", { class: "cards" }, ...cards.map(({ card }) => card));
  if (campaigns.length < 2) return [list];
  const searchInput = make("input", { type: "search", autocomplete: "off" });
  const orderSelect = make("select", {}, ...Object.keys(SORT_KEYS).map((label) => make("option", {}, label)));
  const countText = make("p", { class: "quiet", role: "status" });
  const updateList = () => {
    const searchWords = searchInput.value.toLowerCase().split(/\s+/).filter(Boolean);
    const sortKey = SORT_KEYS[/** @type {keyof typeof SORT_KEYS} */ (orderSelect.value)];
    const foundCards = cards.filter(({ card }) =>
      searchWords.every((word) => card.textContent?.toLowerCase().includes(word)));
    foundCards.sort((first, second) => (sortKey(first.campaign) < sortKey(second.campaign) ? -1 : 1));
    list.replaceChildren(...foundCards.map(({ card }) => card));
    countText.textContent = searchWords.length ? `${foundCards.length} of ${cards.length}` : "";
  };
  searchInput.addEventListener("input", updateList);
  orderSelect.addEventListener("change", updateList);
  return [make("div", { class: "row" }, labelled("Search", searchInput), labelled("Sort by", orderSelect), countText), list];
}

function newCampaign() {
  const name = make("input", { required: true, autocomplete: "off", placeholder: "my-campaign" });
  const test = make("select", {},
    make("option", { value: "double-turntable" }, "Double turntable"),
    make("option", { value: "tumble" }, "Tumble test"),
    make("option", { value: "arm" }, "Arm centrifuge"));
  const errorBox = make("div");
  const form = make("form", {
    class: "row",
    onsubmit: submitHandler(errorBox, async () => {
      errorBox.replaceChildren(working("Writing the example"));
      const response = await send("POST", "campaign", { name: name.value, test: test.value });
      say(`Wrote ${response.name}/campaign.toml.`);
      location.hash = campaignAddress(response.name);
    }),
  }, labelled("Example folder", name), labelled("Test type", test),
  make("button", {}, "Write example"));
  return [
    make("h2", {}, "New campaign"), importEntry(),
    make("details", {}, make("summary", {}, "Start from a template"), form, errorBox),
  ];
}

/**
 * A control chart of each instrument, if there are several results.
 * @param {string[]} names of results
 */
function instrumentCharts(names) {
  const container = make("section", { class: "instruments" });
  if (names.length > 1) {
    pagePart("history", names).then(({ part }) => {
      const charts = [...part?.querySelectorAll("figure") ?? []];
      if (!charts.length) return;
      container.append(make("h2", {}, "Instruments"), make("div", { class: "charts report" }, ...charts));
      globalThis.counterspin.draw(container);
    }, () => {}); // The next request reports an error of the server.
  }
  return container;
}

/**
 * The campaigns in the trash, each with a button that restores it.
 * @param {{place: string, name: string}[]} trash
 */
function trashPart(trash) {
  const errorBox = make("div");
  const restore = (/** @type {string} */ trashName) => () => attempt(errorBox, async () => {
    errorBox.replaceChildren(working("Restoring"));
    const { name, files } = await send("POST", "restore", { place: trashName });
    say(`Restored ${name}.`);
    if (files.length) keepImport({ folder: name, names: files, uploaded: files, test: "", answers: {} });
    location.hash = files.length ? "#/import" : campaignAddress(name);
  });
  return make("details", { class: "keeping" }, make("summary", {}, `Trash (${trash.length})`),
    ...trash.map(({ place: trashName, name }) => make("div", { class: "row" }, make("span", {}, name),
      make("button", { type: "button", onclick: restore(trashName) }, `Restore ${name}`))), errorBox);
}

/** Scroll to the import of a new campaign. */
function goToImport() {
  const field = /** @type {HTMLElement} */ (document.querySelector(".drop input"));
  field.closest("section")?.scrollIntoView();
  field.focus({ preventScroll: true });
}

/** The list of campaigns. */
export async function folderView() {
  const folder = await get("folder");
  const results = folder.results.filter((result) => result.state !== "damaged");
  const content = [
    make("div", { class: "head" }, make("h1", {}, folder.folder),
      folder.campaigns.length > 2 ? make("button", { type: "button", class: "main", onclick: goToImport }, "New campaign") : null),
    ...folder.campaigns.length
      ? campaignList(folder.campaigns)
      : [make("p", {}, "counterspin calibrates accelerometers from records of a centrifuge or tumble test. It estimates the error " +
        "coefficients, in particular K_II, and their uncertainties. This folder contains no campaigns yet.")],
    instrumentCharts([...folder.campaigns.flatMap((campaign) => campaign.results), ...folder.results]
      .filter((result) => result.state !== "damaged").map((result) => result.name)),
    make("section", {}, ...newCampaign()),
  ];
  if (results.length) {
    content.push(make("section", {}, make("h2", {}, "Other results"),
      make("ul", { class: "cards" }, ...results.map((result) =>
        make("li", { class: "card" }, make("h3", {}, result.title || result.name), ...resultLines(result))))));
  }
  if (folder.trash.length) content.push(trashPart(folder.trash));
  return { title: folder.folder, content };
}

