"use strict";

/* The measured X-rays, wiped over by the re-projected ones, their difference and the misfit of each view. */
class XrayViewer {
  constructor() {
    byId("wipe").addEventListener("input", () => this.draw());
  }

  /* Shows a case's X-rays, null for none; misfits: of each view. */
  show(xrays, misfits) {
    [this.xrays, this.misfits, this.view] = [xrays, misfits, 0];
    for (const id of ["xray", "residual"]) byId(id).parentNode.hidden = !xrays;
    byId("xrays").hidden = !xrays && !misfits.length;
    const most = Math.max(...misfits.map(value => value ?? 0), 1e-9);
    byId("bars").replaceChildren(...misfits.map((value, view) => element("button", {
      type: "button", "aria-label": `view ${view}: misfit ${value?.toPrecision(3) ?? "unknown"}`,
      onclick: () => { this.view = view; this.draw(); }},
      element("span", {style: `height: ${100 * (value ?? 0) / most}%`}))));
    this.draw();
  }

  draw() {
    for (const [n, bar] of [...byId("bars").children].entries()) bar.setAttribute("aria-pressed", n === this.view);
    byId("view-name").textContent = `view ${this.view} of ${this.misfits.length}, misfit ` +
      `${this.misfits[this.view]?.toPrecision(3) ?? "unknown"}`;
    if (!this.xrays) return;
    const {shape: [, tall, wide], low, step, measured, rendered} = this.xrays, size = wide * tall;
    const [y, p] = [measured, rendered].map(all => all.subarray(this.view * size, (this.view + 1) * size));
    const edge = wide * byId("wipe").value / 100, residual = Float32Array.from(p, (code, n) => step * (code - y[n]));
    const top = 65535 * step || 1, most = residual.reduce((a, b) => Math.max(a, Math.abs(b)), step);
    paint(byId("xray"), y, wide, tall, tall / wide,
          (code, n) => Array(3).fill(255 * step * (n % wide < edge ? code : p[n]) / top));
    paint(byId("residual"), residual, wide, tall, tall / wide, value => signed(value / most));
    byId("residual-scale").textContent = `residual, ±${most.toPrecision(2)} in line integrals from ` +
      `${low.toPrecision(2)} to ${(low + top).toPrecision(2)}; red: re-projected too high`;
  }
}
