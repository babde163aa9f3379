// Numbers as the operator reads them. Inside everything is SI; here it is turned into words.

const SI = {
  rate: [1, "L/ha", 1], flow: [1, "L/min", 2], volume: [1, "L", 1], speed: [1, "m/s", 1],
  length: [1, "m", 1], area: [1, "ha", 2], pressure: [0.01, "bar", 2], wind: [1, "m/s", 1],
};
const US = {
  rate: [0.106907, "gal/ac", 2], flow: [0.264172, "gal/min", 2], volume: [0.264172, "gal", 1],
  speed: [2.236936, "mph", 1], length: [3.28084, "ft", 0], area: [2.471054, "ac", 2],
  pressure: [0.1450377, "psi", 1], wind: [2.236936, "mph", 1],
};

let table = SI;

export function useUnits(name) {
  table = name === "us" ? US : SI;
}

export function unitOf(kind) {
  return table[kind][1];
}

export function value(kind, number) {
  if (number === null || number === undefined) return "–";
  const [factor, , digits] = table[kind];
  return (number * factor).toFixed(digits);
}

export function withUnit(kind, number) {
  return number === null || number === undefined ? "–" : `${value(kind, number)} ${table[kind][1]}`;
}

// From the operator's unit back to SI.
export function toSi(kind, number) {
  return number / table[kind][0];
}
