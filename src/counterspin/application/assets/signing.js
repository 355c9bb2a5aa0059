// @ts-check
// The signature of a certificate. Key and password are used for a single request and not stored.

import { labelled, make } from "./dom.js";

/**
 * Name and Base64 content of a file.
 * @param {File} file
 * @returns {Promise<{name: string, content: string}>}
 */
const encodeFile = (file) => new Promise((resolve, reject) => {
  const reader = new FileReader();
  reader.onload = () => resolve({ name: file.name, content: String(reader.result).split(",")[1] ?? "" });
  reader.onerror = () => reject(new Error(`${file.name} cannot be read.`));
  reader.readAsDataURL(file);
});

/** The fields of the signature. */
export class Signing {
  /**
   * @param {string} signer whose command the server was started with; empty: nobody's
   * @param {() => void} onChange
   */
  constructor(signer, onChange) {
    this.methodSelect = make("select", {
      onchange: () => {
        this.show();
        onChange();
      },
    },
      signer ? make("option", { value: "command" }, `Signing command of the server: ${signer}`) : null,
      make("option", { value: "key" }, "Key file"),
      make("option", { value: "" }, "No signature"));
    this.key = make("input", { type: "file", accept: ".pem,.key,.p12,.pfx", onchange: onChange });
    this.certificate = make("input", { type: "file", accept: ".pem,.crt,.cer" });
    this.password = make("input", { type: "password", autocomplete: "off" });
    this.files = make("div", { class: "row" },
      labelled("Key file (PEM or PKCS #12)", this.key),
      labelled("Signer's certificate (PEM), if not in the key file", this.certificate),
      labelled("Key password (if encrypted)", this.password));
    this.remark = make("p", { class: "quiet" });
    this.element = make("div", {}, make("div", { class: "row" }, labelled("Signature", this.methodSelect)),
      this.files, this.remark);
    this.show();
  }

  /** Whether the certificate is signed. */
  get isSigned() {
    return this.methodSelect.value !== "";
  }

  /** The missing entry of the signature; empty if it is complete. */
  get gap() {
    return this.methodSelect.value === "key" && !this.key.files?.length ? "Key file" : "";
  }

  focus() {
    this.key.scrollIntoView({ block: "center" });
    this.key.focus({ preventScroll: true });
  }

  show() {
    this.files.hidden = this.methodSelect.value !== "key";
    this.remark.textContent = {
      "": "",
      key: "The server signs both XML and PDF. The key and the password are used only for this request and are not stored.",
      command: "The server signs both XML and PDF.",
    }[this.methodSelect.value] ?? "";
  }

  /**
   * The signature for a request; this clears the password.
   * @returns {Promise<any>}
   */
  async request() {
    if (this.methodSelect.value === "") return undefined;
    if (this.methodSelect.value === "command") return {};
    const [key, certificate] = [this.key.files?.[0], this.certificate.files?.[0]];
    if (!key) throw new Error("Choose a key file.");
    const password = this.password.value;
    this.password.value = "";
    return {
      key: await encodeFile(key),
      ...(certificate ? { certificate: await encodeFile(certificate) } : {}),
      ...(password ? { password } : {}),
    };
  }
}
