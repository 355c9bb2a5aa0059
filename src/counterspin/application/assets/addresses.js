// @ts-check
// Addresses of campaigns and results in the page.

/** @type {(name: string) => string} */
export const campaignAddress = (name) => `#/campaign/${encodeURIComponent(name)}`;

/** @type {(name: string, id?: string) => string} of a field or a section, where one is named */
export const descriptionAddress = (name, id) => `#/description/${encodeURIComponent(name)}${id ? `#${encodeURIComponent(id)}` : ""}`;

/** @type {(name: string) => string} */
export const resultAddress = (name) => `#/result/${encodeURIComponent(name)}`;
