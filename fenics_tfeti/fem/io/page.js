"use strict";
// The figures of a page: their data are in the element "data", see page.py.
const data = JSON.parse(document.getElementById("data").textContent);
const config = { responsive: true, displaylogo: false };
const ink = getComputedStyle(document.body).color;
const font = { family: "system-ui, sans-serif", size: 13, color: ink };

function decode(array, kind) {
  const bytes = Uint8Array.from(atob(array), (c) => c.charCodeAt(0));
  return new kind(bytes.buffer);
}

function bodies(scene) {
  const [X, Y, Z] = scene.points.map((a) => decode(a, Float32Array));
  const [U, V, W] = scene.displacement.map((a) => decode(a, Float32Array));
  const [i, j, k] = scene.triangles.map((a) => decode(a, Int32Array));
  const fields = scene.fields.map((f) => ({ ...f, values: decode(f.values, Float32Array) }));
  const moved = (x, u, s) => x.map((value, n) => value + s * u[n]);
  const element = document.getElementById("bodies");
  const choice = document.getElementById("field");
  const range = document.getElementById("scale");
  // a phone held upright: the bar below, the eye farther away
  const narrow = element.clientWidth < 600;
  const distance = Math.max(1, (1.1 * element.clientHeight) / element.clientWidth);
  const bar = narrow
    ? { orientation: "h", y: 0, yanchor: "bottom", len: 0.9 }
    : { thickness: 14 };
  const side = narrow ? "top" : "right";
  const colours = () => {
    const field = fields[choice.selectedIndex];
    return {
      intensity: field.values,
      intensitymode: field.mode,
      colorbar: { ...bar, title: { text: field.label, side } },
    };
  };
  const positions = () => {
    const s = scene.scale * Number(range.value);
    document.getElementById("factor").textContent = "× " + Number(s.toPrecision(3));
    return { x: moved(X, U, s), y: moved(Y, V, s), z: moved(Z, W, s) };
  };
  const flat = scene.flat;
  const axis = { visible: false };
  const layout = {
    font,
    margin: { l: 0, r: 0, t: 0, b: 0 },
    scene: {
      aspectmode: "data",
      xaxis: axis,
      yaxis: axis,
      zaxis: axis,
      dragmode: "orbit",
      camera: flat
        ? { eye: { x: 0, y: 0, z: 2 * distance }, up: { x: 0, y: 1, z: 0 } }
        : { eye: { x: -1.0 * distance, y: -1.5 * distance, z: 0.9 * distance } },
    },
  };
  const mesh = {
    type: "mesh3d",
    ...{ i, j, k },
    ...positions(),
    ...colours(),
    colorscale: "YlOrRd",
    reversescale: true,
    flatshading: true,
    lighting: flat ? { ambient: 1, diffuse: 0 } : { ambient: 0.8, diffuse: 0.3, specular: 0.05 },
    hovertemplate: "%{intensity:.4g}<extra></extra>",
  };
  const update = () => Plotly.react(element, [{ ...mesh, ...positions(), ...colours() }], layout);
  choice.addEventListener("change", update);
  range.addEventListener("input", update);
  // what the user has turned stays
  layout.uirevision = layout.scene.uirevision = "kept";
  return Plotly.newPlot(element, [mesh], layout, config);
}

function curves(name, figure) {
  const layout = { font, margin: { l: 70, r: 15, t: 10, b: 45 }, ...figure.layout };
  return Plotly.newPlot(name, figure.traces, layout, config);
}

const drawn = Object.entries(data.figures).map(([name, figure]) => curves(name, figure));
if (data.scene) drawn.push(bodies(data.scene));
Promise.all(drawn).then(() => {
  document.body.dataset.drawn = "true";
});
