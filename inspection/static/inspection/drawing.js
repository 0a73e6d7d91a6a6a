// What all charts share: colours of the present theme, range images decoded from int16, and colour scales that
// colour-blind people can read.

const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export function look(extra = {}) {
  const axis = { gridcolor: css("--line"), zerolinecolor: css("--line-strong"), linecolor: css("--line-strong") };
  const { xaxis, yaxis, ...rest } = extra;
  return {
    font: { family: getComputedStyle(document.body).fontFamily, size: 13, color: css("--ink") },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 62, r: 16, t: 12, b: 46 },
    hoverlabel: { font: { size: 13 } },
    ...rest,
    xaxis: { ...axis, ...xaxis },
    yaxis: { ...axis, ...yaxis },
  };
}

export const config = { displaylogo: false, responsive: true, displayModeBar: false, doubleClick: false };
export const colour = css;

/** Fetch a range picture. Rows are views into one buffer; NaN is "not measured". Throws with the server's sentence. */
export async function fetchPicture(url) {
  const answer = await fetch(url, { credentials: "same-origin" });
  if (!answer.ok) {
    const fault = await answer.json().catch(() => ({}));
    throw new Error(fault.detail ?? `The server answered ${answer.status}.`);
  }
  const numbers = (name) => answer.headers.get(name).split(",").map(Number);
  const [rows, columns] = numbers("X-Shape");
  const [scale] = numbers("X-Scale");
  const [none] = numbers("X-No-Data");
  const [y0, x0] = numbers("X-Origin-mm");
  const [dy, dx] = numbers("X-Cell-mm");
  const counts = new DataView(await answer.arrayBuffer());
  const values = new Float32Array(rows * columns);
  for (let i = 0; i < values.length; i++) {
    const count = counts.getInt16(2 * i, true);
    values[i] = count === none ? NaN : count * scale;
  }
  const z = Array.from({ length: rows }, (_, row) => values.subarray(row * columns, (row + 1) * columns));
  return { z, x0, y0, dx, dy, rows, columns, unit: answer.headers.get("X-Unit"), span: numbers("X-Span") };
}

export const unitWord = (unit) => ({ um: "µm", mm3: "mm³", mm2: "mm²" })[unit] ?? unit;

export function fail(element, error) {
  const wait = element.querySelector(".chart-wait") ?? element;
  wait.textContent = error.message;
  wait.hidden = false;
}
