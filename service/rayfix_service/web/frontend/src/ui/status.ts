/** What the viewer says of itself: loading, failing, and short notices. */

import { h, replace } from "../dom";

export class StatusScreen {
  private readonly element = h("div", { id: "status", role: "alert" });

  constructor(root: HTMLElement) {
    root.append(this.element);
  }

  loading(text: string): void {
    this.element.className = "loading";
    replace(this.element, h("div", { className: "card" }, h("div", { className: "spinner" }), h("p", {}, text)));
    this.element.hidden = false;
  }

  /** Say what failed; resolves when the person wants to try again. */
  failed(title: string, text: string): Promise<void> {
    return new Promise((resolve) => {
      const again = h("button", { type: "button", className: "primary", onclick: () => resolve() }, "Try again");
      this.element.className = "failed";
      replace(this.element, h("div", { className: "card" }, h("h2", {}, title), h("p", {}, text), again));
      this.element.hidden = false;
      again.focus();
    });
  }

  /** Ask for the key that the service wants. */
  askKey(wrong: boolean): Promise<string> {
    return new Promise((resolve) => {
      const input = h("input", { id: "key", type: "password", autocomplete: "off", required: true });
      const form = h(
        "form",
        {
          className: "card",
          onsubmit: (event: Event) => {
            event.preventDefault();
            resolve(input.value.trim());
          },
        },
        h("span", { className: "brand" }, "rayfix"),
        h("h2", {}, h("label", { htmlFor: "key" }, "API key")),
        h("p", { className: wrong ? "warning" : "muted" }, wrong ? "The service does not know this key." : "The service asks for a key. It is kept until this tab is closed."),
        input,
        h("button", { type: "submit", className: "primary" }, "Open"),
        h("a", { href: "docs" }, "The HTTP interface"),
      );
      this.element.className = "key";
      replace(this.element, form);
      this.element.hidden = false;
      input.focus();
    });
  }

  done(): void {
    this.element.hidden = true;
    document.documentElement.dataset["ready"] = "";
  }
}

const SHOWN = 6000; // ms

/** Short notices at the bottom. */
export class Notices {
  private readonly element = h("div", { id: "notices", role: "status", "aria-live": "polite" });

  constructor(root: HTMLElement) {
    root.append(this.element);
  }

  show(text: string, kind: "info" | "error" = "info"): void {
    const close = (): void => notice.remove();
    const notice = h(
      "div",
      { className: `notice ${kind}` },
      h("span", {}, text),
      h("button", { type: "button", "aria-label": "Close", onclick: close }, "×"),
    );
    this.element.append(notice);
    while (this.element.childElementCount > 3) this.element.firstElementChild!.remove();
    setTimeout(close, kind === "error" ? 2 * SHOWN : SHOWN);
  }
}
