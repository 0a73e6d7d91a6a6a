// The difference of two scans of one region: blue gained, red lost, white unchanged.
import { colour, config, fail, fetchPicture, look } from "./drawing.js";

const map = document.querySelector("[data-difference]");
async function draw() {
  try {
    const picture = await fetchPicture(map.dataset.difference);
    const most = Math.max(Math.abs(picture.span[0]), Math.abs(picture.span[1]), 1);
    map.querySelector(".chart-wait")?.remove();
    const turned = picture.rows * picture.dy > 1.3 * picture.columns * picture.dx;
    const [flat, upright] = turned ? ["across the bevel, mm", "along the edge, mm"] : ["along the edge, mm", "across the bevel, mm"];
    const laid = turned
      ? { z: Array.from(picture.z[0], (_, c) => Float32Array.from(picture.z, (row) => row[c])), x0: picture.y0, dx: picture.dy, y0: picture.x0, dy: picture.dx }
      : { z: picture.z, x0: picture.x0, dx: picture.dx, y0: picture.y0, dy: picture.dy };
    await Plotly.newPlot(map, [{
      type: "heatmap", ...laid, zmin: -most, zmax: most,
      colorscale: "RdBu", reversescale: true, hoverongaps: false, colorbar: { title: { text: "µm", side: "top" }, thickness: 14, outlinewidth: 0 },
      hovertemplate: "%{x:.3f} mm, %{y:.3f} mm<br><b>%{z:.1f} µm</b><extra></extra>",
    }], look({
      plot_bgcolor: colour("--hatch-1"), margin: { l: 58, r: 8, t: 8, b: 46 },
      xaxis: { title: { text: flat }, showgrid: false, zeroline: false, constrain: "domain" },
      yaxis: { title: { text: upright }, autorange: "reversed", showgrid: false, zeroline: false, scaleanchor: "x", constrain: "domain" },
    }), { ...config, doubleClick: "reset" });
    map.dataset.drawn = "difference";
  } catch (error) {
    fail(map, error);
  }
}
document.addEventListener("theme", draw);
draw();
