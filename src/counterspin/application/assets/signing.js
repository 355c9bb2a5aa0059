// @ts-check
// With what a certificate is signed. A key and its password go into one request and are forgotten.

import { labelled, make } from "./dom.js";

/**
 * A file as a request carries it.
 * @param {File} file
 * @returns {Promise<{name: string, content: string}>}
 */
const carried = (file) => new Promise((done, failed) => {
  const reader = new FileReader();
  reader.onload = () => done({ name: file.name, content: String(reader.result).split(",")[1] ?? "" });
  reader.onerror = () => failed(new Error(`${file.name} cannot be read.`));
  reader.readAsDataURL(file);
});

/** The fields that say who signs. */
export class Signing {
  /**
   * @param {string} signer whose command the server was started with; empty: nobody's
   * @param {() => void} changed
   */
  constructor(signer, changed) {
    this.how = make("select", {
      onchange: () => {
        this.show();
        changed();
      },
    },
      signer ? make("option", { value: "command" }, `Signing command of the server: ${signer}`) : null,
      make("option", { value: "key" }, "Key file"),
      make("option", { value: "" }, "No signature"));
    this.key = make("input", { type: "file", accept: ".pem,.key,.p12,.pfx", onchange: changed });
    this.certificate = make("input", { type: "file", accept: ".pem,.crt,.cer" });
    this.password = make("input", { type: "password", autocomplete: "off" });
    this.files = make("div", { class: "row" },
      labelled("Key file (PEM or PKCS #12)", this.key),
      labelled("Signer's certificate (PEM), if not in the key file", this.certificate),
      labelled("Key password (if encrypted)", this.password));
    this.words = make("p", { class: "quiet" });
    this.element = make("div", {}, make("div", { class: "row" }, labelled("Signature", this.how)),
      this.files, this.words);
    this.show();
  }

  /** Whether it is signed at all. */
  get wanted() {
    return this.how.value !== "";
  }

  /** What the signature lacks; empty: nothing. */
  get gap() {
    return this.how.value === "key" && !this.key.files?.length ? "Key file" : "";
  }

  focus() {
    this.key.scrollIntoView({ block: "center" });
    this.key.focus({ preventScroll: true });
  }

  show() {
    this.files.hidden = this.how.value !== "key";
    this.words.textContent = {
      "": "",
      key: "The server signs both XML and PDF. The key and the password are used only for this request and are not stored.",
      command: "The server signs both XML and PDF.",
    }[this.how.value] ?? "";
  }

  /**
   * What a request says; the password is forgotten here.
   * @returns {Promise<any>}
   */
  async said() {
    if (this.how.value === "") return undefined;
    if (this.how.value === "command") return {};
    const [key, certificate] = [this.key.files?.[0], this.certificate.files?.[0]];
    if (!key) throw new Error("Choose a key file.");
    const password = this.password.value;
    this.password.value = "";
    return {
      key: await carried(key),
      ...(certificate ? { certificate: await carried(certificate) } : {}),
      ...(password ? { password } : {}),
    };
  }
}
