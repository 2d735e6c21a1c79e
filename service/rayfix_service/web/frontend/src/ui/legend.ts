/** What the colours mean. */

import { h, replace, swatch } from "../dom";
import { hex, theme } from "../theme";

/** Write the legend; call what it returns when tracks have come or gone. */
export function drawLegend(element: HTMLElement, maxReflections: number, hasTracks: () => boolean): () => void {
  const draw = (): void => {
    const { palette } = theme;
    const entry = (colour: number, text: string): HTMLElement => h("span", {}, swatch(hex(colour)), text);
    const paths = Array.from({ length: maxReflections + 1 }, (_, n) =>
      entry(theme.reflections(n), n === 0 ? "direct" : n === 1 ? "1 reflection" : `${n} reflections`),
    );
    replace(
      element,
      entry(palette.station, "station"),
      entry(palette.fix, "fix, 2σ"),
      hasTracks() && entry(palette.track, "track, 2σ"),
      entry(palette.rival, "rival"),
      entry(palette.truth, "truth"),
      ...paths,
    );
  };
  theme.onChange(draw);
  draw();
  return draw;
}
