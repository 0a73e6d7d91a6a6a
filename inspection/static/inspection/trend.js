// How one number of a tool wears: a line per region, limits, events, and the forecast of the present edge.
import { colour, config, fail, look, unitWord } from "./drawing.js";

const panel = document.getElementById("trend");
const chart = panel.querySelector("[data-chart]");
const choice = panel.querySelector("[data-metric]");
const sentences = panel.querySelector("[data-sentences]");
// Okabe and Ito's colours: told apart by everybody.
const LINES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
const SYMBOLS = ["circle", "square", "diamond", "triangle-up", "x", "star"];
//: More event labels than this cover each other.
const MOST_LABELS = 12;

async function draw() {
  try {
    const answer = await fetch(`${panel.dataset.url}?${new URLSearchParams({ metric: choice.value })}`);
    if (!answer.ok) throw new Error(`The server answered ${answer.status}.`);
    const { series } = await answer.json();
    if (!series.length) return;
    const unit = unitWord(series[0].metric.unit);
    const traces = series.flatMap((one, index) => [...fitTraces(one, index), ...lineTraces(one, index, unit)]);
    await Plotly.react(chart, traces, layout(series, unit), config);
    chart.removeAllListeners?.("plotly_click");
    chart.on("plotly_click", (event) => {
      const address = event.points[0].customdata;
      if (typeof address === "string") location.href = address;
    });
    sentences.replaceChildren(...series.filter((one) => one.sentence && one.points.length).map((one) => {
      const line = document.createElement("p");
      line.innerHTML = "<b></b> ";
      line.firstChild.textContent = `${one.region.name}:`;
      line.append(one.sentence);
      return line;
    }));
    panel.dataset.drawn = choice.value;
  } catch (error) {
    fail(sentences, error);
  }
}

function lineTraces(one, index, unit) {
  // a line per segment: no line crosses a regrind
  const segments = Map.groupBy ? Map.groupBy(one.points, (p) => p.segment) : group(one.points);
  return [...segments.values()].map((points, nth) => ({
    type: "scatter", mode: "lines+markers", name: one.region.name, legendgroup: one.region.name, showlegend: nth === segments.size - 1,
    x: points.map((p) => p.t), y: points.map((p) => p.value), customdata: points.map((p) => p.url),
    error_y: { type: "data", array: points.map((p) => (p.u === null ? 0 : 2 * p.u)), thickness: 1, width: 3 },
    line: { color: LINES[index % LINES.length], width: 1.5 },
    marker: { symbol: points.map((p) => SYMBOLS[index % SYMBOLS.length] + (p.used === false ? "-open" : "")), size: 8 },
    hovertemplate: `%{x|%d %b %Y}<br><b>%{y:.4g} ${unit}</b><extra>${one.region.name}</extra>`,
  }));
}

function group(points) {
  const found = new Map();
  for (const point of points) found.set(point.segment, [...(found.get(point.segment) ?? []), point]);
  return found;
}

function fitTraces(one, index) {
  if (!one.fit?.line?.length || one.fit.line[0].t === null || one.fit.line[0].t === undefined) return [];
  const line = one.fit.line;
  const paint = LINES[index % LINES.length];
  const x = line.map((p) => p.t);
  const still = { hoverinfo: "skip", showlegend: false, legendgroup: one.region.name, type: "scatter", mode: "lines" };
  const traces = [{ ...still, x, y: line.map((p) => p.value), line: { color: paint, width: 1, dash: "dash" } }];
  if (line[0].low !== null && line[0].low !== undefined) {
    traces.unshift(
      { ...still, x, y: line.map((p) => p.low), line: { width: 0 } },
      { ...still, x, y: line.map((p) => p.high), line: { width: 0 }, fill: "tonexty", fillcolor: `${paint}1f` },
    );
  }
  return traces;
}

// The readings and the limits decide what is seen, not the width of a forecast's band.
function reach(series) {
  const limits = [series[0].limits?.watch, series[0].limits?.replace].filter((v) => typeof v === "number");
  const points = series.flatMap((one) => one.points).filter((p) => p.value !== null);
  const high = Math.max(...points.map((p) => p.value + 2 * (p.u ?? 0)), series[0].limits?.watch ?? 0);
  const top = Math.max(high, ...limits.filter((v) => v < 3 * high)) * 1.12 || 1;
  return [Math.min(0, ...points.map((p) => p.value - 2 * (p.u ?? 0))), top];
}

function layout(series, unit) {
  const shapes = [];
  const annotations = [];
  const limits = series[0].limits;
  for (const [kind, tone] of [["watch", "--watch"], ["replace", "--replace"]]) {
    const at = limits?.[kind];
    if (at === null || at === undefined) continue;
    shapes.push({ type: "line", xref: "paper", x0: 0, x1: 1, y0: at, y1: at, line: { color: colour(tone), width: 1.5, dash: "dash" } });
    annotations.push({ xref: "paper", x: 1, y: at, text: `${kind} ${at} ${unit}`, showarrow: false, xanchor: "right", yanchor: "bottom", font: { color: colour(tone) } });
  }
  const events = series[0].events.filter((event) => event.kind !== "note");
  for (const event of events) {
    shapes.push({ type: "line", x0: event.t, x1: event.t, yref: "paper", y0: 0, y1: 1, line: { color: colour("--ink-2"), width: event.ends_segment ? 2 : 1, dash: "dot" } });
  }
  for (const event of events.slice(-MOST_LABELS)) {
    annotations.push({ x: event.t, yref: "paper", y: 1, text: event.label, showarrow: false, textangle: -90, xanchor: "right", yanchor: "top", font: { size: 11, color: colour("--ink-2") } });
  }
  return look({
    shapes, annotations, uirevision: "stay", hovermode: "closest", legend: { orientation: "h", y: 1.12, x: 0 }, margin: { l: 62, r: 16, t: 34, b: 40 },
    xaxis: { type: "date" }, yaxis: { title: { text: `${series[0].metric.label}, ${unit}` }, range: reach(series) },
  });
}

choice.addEventListener("change", draw);
document.addEventListener("theme", draw);
draw();
