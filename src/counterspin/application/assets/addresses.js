// @ts-check
// Where on the page campaigns and results stand.

/** @type {(name: string) => string} */
export const campaignAddress = (name) => `#/campaign/${encodeURIComponent(name)}`;

/** @type {(name: string) => string} */
export const resultAddress = (name) => `#/result/${encodeURIComponent(name)}`;
