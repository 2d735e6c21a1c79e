/**
 * Numbers as their standard deviation deserves: the deviation to two significant digits, the value to the same decimal
 * place (GUM, JCGM 100:2008, 7.2.6).
 */

const DIGITS = 2;
const MOST_DECIMALS = 6;
const UNKNOWN = 2; // decimals of a value whose deviation is not known

/** Decimal places of a value with this standard deviation; negative ones are tens, hundreds. */
export function decimalsOf(stdev: number): number {
  if (!(stdev > 0) || !Number.isFinite(stdev)) return UNKNOWN;
  // Rounded first: 0.0996 has as many places as 0.10.
  const exponent = Number(stdev.toExponential(DIGITS - 1).split("e")[1]);
  return Math.min(DIGITS - 1 - exponent, MOST_DECIMALS);
}

/** A value to so many decimal places, without a minus where nothing is left of it. */
export function fixed(value: number, decimals: number): string {
  const unit = 10 ** Math.max(0, -decimals);
  const text = (Math.round(value / unit) * unit).toFixed(0);
  const rounded = decimals < 0 ? text : value.toFixed(decimals);
  return Number(rounded) === 0 ? rounded.replace("-", "") : rounded;
}

/** A value as its deviation deserves. */
export const rounded = (value: number, stdev: number): string => fixed(value, decimalsOf(stdev));

/** A deviation or an accuracy to two significant digits. */
export const deviation = (stdev: number): string => fixed(stdev, decimalsOf(stdev));

/** Such as "15.20 ± 0.50 m" and "69.6 ± 1.0°". */
export function withDeviation(value: number, stdev: number, unit: string): string {
  return `${rounded(value, stdev)} ± ${deviation(stdev)}${unit}`;
}

/** A difference with its sign, as the deviation of what was measured deserves. */
export function signed(value: number, stdev: number, unit: string): string {
  const text = rounded(Math.abs(value), stdev);
  const sign = Number(text) === 0 ? "" : value < 0 ? "−" : "+";
  return `${sign}${text}${unit}`;
}
