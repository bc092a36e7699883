// Helpers of all checks. Numbers agree within 1e-9 or the given tolerance; NaN agrees with nothing.
const wrong = [];
const alike = (a, b, within) => {
  if (typeof a === "number" && typeof b === "number") return a === b || Math.abs(a - b) <= within;
  if (!a || !b || typeof a !== "object" || typeof b !== "object") return a === b;
  const names = Object.keys(a);
  return names.length === Object.keys(b).length && names.every((name) => name in b && alike(a[name], b[name], within));
};
const is = (name, found, wanted, within = 1e-9) => {
  const words = (value) => String(JSON.stringify(value)).slice(0, 500);
  if (!alike(found, wanted, within)) wrong.push(`${name}: ${words(found)} in place of ${words(wanted)}`);
};
/** Calls of replaced functions of the page. */
const calls = [];
const called = () => calls.splice(0);
let clock = 1000;
const fixed = (object, name, value) => Object.defineProperty(object, name, { value, configurable: true, writable: true });
