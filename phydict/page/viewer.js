"use strict";
// level and width in HU
const WINDOWS = {all: [-300, 1400], lung: [-600, 1500], "soft tissue": [40, 400], bone: [400, 1800]};
const PLANES = {axial: {across: 2, x: 0, y: 1, edges: "RLAP"}, coronal: {across: 1, x: 0, y: 2, edges: "RLSI"},
                sagittal: {across: 0, x: 1, y: 2, edges: "APSI"}};
const SPREAD = 500;  // HU of difference in full colour, and of uncertainty in the strongest
const WIDE = 360;  // pixels across a canvas
const byId = id => document.getElementById(id);

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.map(child => child ?? ""));
  return made;
}

const share = (value, low, high) => Math.min(Math.max((value - low) / (high - low), 0), 1);
const grey = part => {
  const shade = 255 * part;
  return [shade, shade, shade];
};
const signed = part => part > 0 ? [255, 255 * (1 - part), 255 * (1 - part)] : [255 * (1 + part), 255 * (1 + part), 255];
const laidOver = (shade, part) => [shade + part * (255 - shade), shade + part * (160 - shade), shade - part * shade];
const NO_VALUE = [255, 0, 255];  // the colour of a voxel without one

/* Draws values through a colour (value, position -> [r, g, b]) onto a canvas; ratio: its height over its width, within
   limits, so that a picture of few pixels along a side is seen. */
function paint(canvas, values, wide, high, ratio, colour) {
  const image = new ImageData(wide, high), raw = new OffscreenCanvas(wide, high);
  for (let n = 0; n < values.length; n++) {
    const [r, g, b] = colour(values[n], n), at = 4 * n;
    image.data[at] = r; image.data[at + 1] = g; image.data[at + 2] = b; image.data[at + 3] = 255;
  }
  raw.getContext("2d").putImageData(image, 0, 0);
  canvas.width = WIDE;
  canvas.height = Math.round(WIDE * Math.min(Math.max(ratio, 1 / 15), 4));
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = false;
  context.drawImage(raw, 0, 0, canvas.width, canvas.height);
  return context;
}

/* A pale line in a dark one, to be seen on any picture. */
function rule(context, x, y, wide, high) {
  context.fillStyle = "rgba(0, 0, 0, 0.5)";
  context.fillRect(x - 1, y - 1, wide + 2, high + 2);
  context.fillStyle = "rgb(90, 200, 255)";
  context.fillRect(x, y, wide, high);
}

class Viewer {
  constructor() {
    this.window = [...WINDOWS.all];
    this.angle = 0;
    this.mean = false;
    this.rolled = 0;  // pixels of the wheel since the last slice
    this.rows = [0, 1].map(row => ({canvases: Object.fromEntries(Object.keys(PLANES).map(name =>
      [name, this.canvas(name, row)])), turning: this.turning()}));
    for (const row of this.rows) for (const canvas of [...Object.values(row.canvases), row.turning])
      byId("planes").append(canvas.parentNode);
    this.turn = element("input", {
      type: "range", min: -180, max: 180, value: 0, "aria-label": "Angle of the projection",
      oninput: () => { this.angle = +this.turn.value; this.drawTurning(); }});
    const kind = element("button", {type: "button", "aria-pressed": "false", onclick: () => {
      this.mean = !this.mean;
      kind.setAttribute("aria-pressed", this.mean);
      this.drawTurning();
    }}, "mean");
    this.rows[0].turning.parentNode.append(element("label", {}, "turn ", this.turn), " ", kind);
    for (const [name, window] of Object.entries(WINDOWS))
      byId("windows").append(element("button", {type: "button", onclick: () => this.setWindow(...window)}, name), " ");
    for (const id of ["level", "width"])
      byId(id).addEventListener("input", () => {
        if (byId(id).value !== "") this.setWindow(+byId("level").value, Math.max(+byId("width").value, 1));
      });
    byId("way").addEventListener("change", () => this.draw());
    byId("overlay").addEventListener("change", () => this.draw());
    this.setWindow(...this.window);
  }

  canvas(name, row) {
    const canvas = element("canvas", {tabindex: 0, role: "slider", "data-plane": name, "data-row": row,
                                      "aria-label": `${name} plane${row ? ", beside it" : ""}`, "aria-valuemin": 1});
    const {across, x, y} = PLANES[name];
    const pick = event => {
      const box = canvas.getBoundingClientRect(), [wide, high] = [this.volume.shape[x], this.volume.shape[y]];
      const i = wide - 1 - Math.floor((event.clientX - box.left) / box.width * wide);
      this.move({[x]: i, [y]: high - 1 - Math.floor((event.clientY - box.top) / box.height * high)});
    };
    let before;
    canvas.addEventListener("pointerdown", event => {
      before = {...this.at};
      if (event.pointerType !== "mouse") return;  // a finger may be about to scroll
      canvas.setPointerCapture(event.pointerId);
      pick(event);
    });
    canvas.addEventListener("pointermove", event => { if (event.buttons) pick(event); });
    canvas.addEventListener("pointercancel", () => this.move(before));  // it scrolls
    canvas.addEventListener("click", pick);
    canvas.addEventListener("wheel", event => {
      if (event.ctrlKey) return;  // the browser's zoom
      event.preventDefault();
      this.rolled += event.deltaY * (event.deltaMode ? 40 : 1);
      if (Math.abs(this.rolled) < 40) return;  // a trackpad sends many small steps
      this.move({[across]: this.at[across] - Math.sign(this.rolled)});
      this.rolled = 0;
    }, {passive: false});
    canvas.addEventListener("keydown", event => {
      if (event.altKey || event.ctrlKey || event.metaKey) return;  // the browser's own
      const size = this.volume.shape[across];
      const step = {ArrowUp: 1, ArrowRight: 1, PageUp: 1, ArrowDown: -1, ArrowLeft: -1, PageDown: -1,
                    Home: -size, End: size}[event.key];
      if (step) {
        event.preventDefault();
        this.move({[across]: this.at[across] + step});
      }
    });
    element("figure", {}, canvas, element("figcaption"));
    return canvas;
  }

  turning() {
    const canvas = element("canvas", {role: "img", "aria-label": "Projection of the volume, turned by the slider"});
    canvas.addEventListener("pointermove", event => {
      if (!event.buttons) return;
      this.turn.value = this.angle = (this.angle + event.movementX + 540) % 360 - 180;
      this.drawTurning();
    });
    element("figure", {}, canvas, element("figcaption"));
    return canvas;
  }

  /* Shows volumes of a patient, at the place in mm where the last ones of the same patient were left. */
  show(volumes, patient) {
    const {reconstruction, truth, ...further} = volumes;
    const mm = patient === this.patient && world(this.volume.affine, this.at);
    [this.volume, this.uncertainty, this.patient] = [reconstruction, Object.values(further)[0] ?? null, patient];
    this.at = mm ? world(this.volume.inverse, mm).map((index, axis) => this.within(Math.round(index), axis))
      : this.volume.shape.map(size => Math.floor(size / 2));
    this.indices = this.volume.indices(this.volume);
    this.other = null;
    byId("overlay-label").hidden = !this.uncertainty;
    byId("overlay-name").textContent = `${this.uncertainty?.name} as overlay`;
    this.draw();
  }

  /* Takes another volume for the second row, null for none; returns whether it can be shown there. */
  compare(other) {
    const indices = other?.indices(this.volume) ?? null;
    this.other = indices && {volume: other, indices};
    byId("way").disabled = !indices;
    this.draw();
    return !other || Boolean(indices);
  }

  /* What the second row's difference is called; nothing where none is shown. */
  difference() {
    return this.other && byId("way").value === "difference" ? `difference from ${this.other.volume.name}` : "";
  }

  setWindow(level, width) {
    this.window = [level, width];
    for (const [n, id] of ["level", "width"].entries())
      if (+byId(id).value !== this.window[n]) byId(id).value = this.window[n];
    for (const button of byId("windows").children)
      button.setAttribute("aria-pressed", String(WINDOWS[button.textContent]) === String(this.window));
    if (this.volume) this.drawPlanes();
  }

  within(index, axis) {
    return Math.min(Math.max(index, 0), this.volume.shape[axis] - 1);
  }

  move(changes) {
    for (const [axis, index] of Object.entries(changes)) this.at[axis] = this.within(index, axis);
    this.drawPlanes();
  }

  draw() {
    this.drawPlanes();
    this.drawTurning();
  }

  drawPlanes() {
    const {volume, at, other} = this, difference = this.difference();
    const overlay = byId("overlay").checked ? this.uncertainty : null;
    byId("difference-scale").hidden = !difference;
    byId("overlay-scale").hidden = !overlay;
    const low = this.window[0] - this.window[1] / 2, high = low + this.window[1];
    const shade = hu => hu === EMPTY ? NO_VALUE : grey(share(hu, low, high));
    for (const [name, plane] of Object.entries(PLANES)) {
      const {across, x, y, edges} = plane, [wide, tall] = [volume.shape[x], volume.shape[y]];
      const ratio = tall * volume.spacing[y] / (wide * volume.spacing[x]);
      const hu = volume.plane(plane, at[across], this.indices);
      const spread = overlay?.plane(plane, at[across], this.indices);
      const beside = other?.volume.plane(plane, at[across], other.indices);
      const overlaid = (value, n) => value === EMPTY || spread[n] === EMPTY ? NO_VALUE
        : laidOver(255 * share(value, low, high), 0.8 * share(spread[n], 0, SPREAD));
      const compared = (value, n) => value === EMPTY || hu[n] === EMPTY ? [128, 128, 128]
        : signed(Math.min(Math.max((hu[n] - value) / SPREAD, -1), 1));
      const colours = [spread ? overlaid : shade, difference ? compared : shade];
      for (const [row, values] of [hu, beside].entries()) {
        const canvas = this.rows[row].canvases[name], figure = canvas.parentNode;
        figure.hidden = !values;
        if (!values) continue;
        const context = paint(canvas, values, wide, tall, ratio, colours[row]);
        this.drawCrosshair(context, (wide - at[x] - 0.5) / wide, (tall - at[y] - 0.5) / tall, edges);
        const mm = world(volume.affine, at)[across].toFixed(1);
        const place = `slice ${at[across] + 1} of ${volume.shape[across]}`;
        canvas.setAttribute("aria-valuenow", at[across] + 1);
        canvas.setAttribute("aria-valuemax", volume.shape[across]);
        canvas.setAttribute("aria-valuetext", `${place}, ${mm} mm`);
        const what = !row ? volume.name : difference || other.volume.name;
        figure.lastChild.textContent = `${name}, ${what}, ${place}`;
      }
    }
    this.readOut();
  }

  drawCrosshair(context, x, y, edges) {
    const {width, height} = context.canvas;
    rule(context, Math.floor(x * width), 0, 1, height);
    rule(context, 0, Math.floor(y * height), width, 1);
    context.fillStyle = "gold";
    context.lineWidth = 3;
    context.font = "13px sans-serif";
    context.textAlign = "center";
    const places = [[8, height / 2], [width - 8, height / 2], [width / 2, 14], [width / 2, height - 5]];
    for (const [n, place] of places.entries()) {
      context.strokeText(edges[n], ...place);
      context.fillText(edges[n], ...place);
    }
  }

  readOut() {
    const {volume, at, other} = this, readings = [[volume.name, volume.at(at)]];
    if (other) readings.push([other.volume.name, other.volume.at(at.map((index, axis) => other.indices[axis][index]))]);
    if (this.difference()) {
      const [one, two] = readings.map(([, hu]) => hu);
      readings.push([this.difference(), one === EMPTY || two === EMPTY ? EMPTY : one - two]);
    }
    if (this.uncertainty) readings.push([this.uncertainty.name, this.uncertainty.at(at)]);
    byId("readout").textContent = `(${world(volume.affine, at).map(mm => mm.toFixed(1)).join(", ")}) mm RAS+: ` +
      readings.map(([name, hu]) => `${name} ${hu === EMPTY ? "no value" : hu + " HU"}`).join(", ");
  }

  drawTurning() {
    const volumes = [this.volume, ...this.other && !this.difference() ? [this.other.volume] : []];
    const seen = volumes.map(volume => volume.projection(this.angle, this.mean, this.volume));
    const low = this.mean ? -1024 : -200;
    const top = seen.reduce((most, {values}) => values.reduce((a, b) => Math.max(a, b), most), low + 1);
    for (const [row, {turning}] of this.rows.entries()) {
      turning.parentNode.hidden = !seen[row];
      if (!seen[row]) continue;
      const {values, wide, high, ratio} = seen[row];
      paint(turning, values, wide, high, ratio, hu => grey(share(hu, low, top)));
      const kind = this.mean ? "mean" : "maximum";
      turning.nextSibling.textContent = `${volumes[row].name}, ${kind} along rays, ${this.angle}°`;
    }
  }
}
