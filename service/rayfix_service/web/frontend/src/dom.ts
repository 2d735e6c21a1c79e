/** Elements in one call. Text is always text: nothing that comes from the service becomes markup. */

type Child = Node | string | null | undefined | false;

export function h<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  properties: Record<string, unknown> = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value as EventListener);
    else if (name in element && !name.startsWith("aria")) Object.assign(element, { [name]: value });
    else {
      const text = value as string | number | true;
      element.setAttribute(name, text === true ? "" : String(text));
    }
  }
  element.append(...children.filter((c): c is Node | string => c !== null && c !== undefined && c !== false));
  return element;
}

export function replace(parent: HTMLElement, ...children: Child[]): void {
  parent.replaceChildren(...children.filter((c): c is Node | string => c !== null && c !== undefined && c !== false));
}

/** A bar whose width is a share from 0 to 1. */
export function bar(share: number, className = ""): HTMLElement {
  const fill = h("span", { className: `fill ${className}` });
  fill.style.width = `${(100 * Math.min(1, Math.max(0, share))).toFixed(1)}%`;
  return h("span", { className: "bar" }, fill);
}

/** A dot of a colour. */
export function swatch(colour: string): HTMLElement {
  const element = h("span", { className: "swatch" });
  element.style.background = colour;
  return element;
}
