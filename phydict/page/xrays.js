"use strict";

/* The measured X-rays left of an edge, the re-projected ones right of it, their difference, the misfit of each view. */
class XrayViewer {
  constructor() {
    byId("wipe").addEventListener("input", () => this.draw());
  }

  /* Shows a case's X-rays, null for none; misfits: of each view. */
  show(xrays, misfits) {
    [this.xrays, this.misfits, this.view] = [xrays, misfits, 0];
    for (const id of ["xray", "residual"]) byId(id).parentNode.hidden = !xrays;
    byId("xrays-part").hidden = !xrays && !misfits.length;
    byId("bars-name").textContent = misfits.length ? "misfit of each view; choose a view" : "choose a view";
    byId("bars").className = misfits.length ? "" : "plain";
    const most = Math.max(...misfits.map(value => value ?? 0), 1e-9);
    const views = Array.from({length: xrays?.shape[0] ?? misfits.length}, (_, view) => view);
    byId("bars").replaceChildren(...views.map(view => element("button", {
      type: "button", "aria-label": `view ${view}${this.misfit(view, ": ")}`,
      onclick: () => { this.view = view; this.draw(); }},
      misfits.length ? element("span", {style: `height: ${100 * (misfits[view] ?? 0) / most}%`}) : view)));
    this.draw();
  }

  /* A view's misfit in words, after `sign`; nothing where it is not known. */
  misfit(view, sign) {
    const value = this.misfits[view] ?? null;
    return value === null ? "" : `${sign}misfit ${value.toPrecision(3)}`;
  }

  draw() {
    const bars = [...byId("bars").children];
    for (const [n, bar] of bars.entries()) bar.setAttribute("aria-pressed", n === this.view);
    byId("view-name").textContent = `view ${this.view} (of 0 to ${bars.length - 1})${this.misfit(this.view, ", ")}`;
    if (!this.xrays) return;
    const {shape: [, tall, wide], pixel = 1, low, step, measured, rendered} = this.xrays, size = wide * tall;
    const ratio = pixel * tall / wide;
    const [y, p] = [measured, rendered].map(all => all.subarray(this.view * size, (this.view + 1) * size));
    const edge = Math.round(wide * byId("wipe").value / 100);
    const residual = Float32Array.from(p, (code, n) => step * (code - y[n]));
    const top = 65535 * step || 1, most = residual.reduce((a, b) => Math.max(a, Math.abs(b)), step);
    const context = paint(byId("xray"), y, wide, tall, ratio,
                          (code, n) => grey(step * (n % wide < edge ? code : p[n]) / top));
    rule(context, Math.round(edge / wide * WIDE), 0, 1, context.canvas.height);
    paint(byId("residual"), residual, wide, tall, ratio, value => signed(value / most));
    byId("residual-scale").textContent = `residual, ±${most.toPrecision(2)} in line integrals from ` +
      `${low.toPrecision(2)} to ${(low + top).toPrecision(2)}; red: re-projected too high`;
  }
}
