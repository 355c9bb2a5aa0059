// @ts-check
// A campaign while its records grow.

import { get } from "./api.js";
import { commandLine, labelled, make, warning } from "./dom.js";
import { campaignTabs } from "./tabs.js";

const PAUSE = 1000;

/**
 * The live view of a campaign.
 * @param {string} name
 */
export async function liveView(name) {
  const campaign = await get("campaign", { name });
  const goal = make("input", { placeholder: "K_II 1e-8 g/g^2", autocomplete: "off" });
  const place = make("div", {}, make("p", { class: "quiet" }, "Looking at the records."));
  const events = make("ul", { class: "quiet", "aria-live": "polite" });
  const command = make("div");
  let shown = "";
  let wanted = "";
  const look = async () => {
    if (!place.isConnected) return;
    try {
      const told = await get("watch", { name, goal: wanted });
      if (told.error) {
        place.replaceChildren(warning(told.error));
        return;
      }
      if (told.html && told.html !== shown) {
        shown = told.html;
        // Escaped by the report's own templates.
        place.innerHTML = told.html;
        place.querySelector("h1")?.remove();
        command.replaceChildren(commandLine(told.command));
        globalThis.counterspin.draw(place);
        told.events.forEach(/** @param {string} one */ (one) => events.prepend(make("li", {}, one)));
      }
      if (told.complete) {
        events.prepend(make("li", {}, "Every run is as long as the campaign states."));
        return;
      }
    } catch (error) {
      place.replaceChildren(warning(/** @type {Error} */ (error).message));
      return;
    }
    setTimeout(look, PAUSE);
  };
  goal.addEventListener("change", () => {
    wanted = goal.value.trim();
    shown = "";
  });
  setTimeout(look);
  return {
    title: `${campaign.title}, live`,
    content: [
      make("h1", {}, campaign.title), campaignTabs(name, "live"),
      make("div", { class: "row" }, labelled("Goal", goal)), place, events, command,
    ],
  };
}
