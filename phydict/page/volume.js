"use strict";
const EMPTY = -32768;  // a voxel that is not finite, or outside of the other volume

async function unpack(text, Kind) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let n = 0; n < bytes.length; n++) bytes[n] = letters.charCodeAt(n);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Kind(await new Response(stream).arrayBuffer());
}

const world = (rows, point) => rows.map(row => row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);

/* A volume in RAS+, x fastest. */
class Volume {
  constructor(name, data, view) {
    Object.assign(this, {name, data, shape: view.shape, affine: view.affine, inverse: view.inverse});
    this.spacing = [0, 1, 2].map(axis => Math.hypot(...this.affine.map(row => row[axis])));
  }

  /* Per axis, this volume's nearest index for each index of another's, -1 outside; null where the axes are askew. */
  indices(other) {
    const origin = world(this.inverse, world(other.affine, [0, 0, 0]));
    const steps = [0, 1, 2].map(axis => world(this.inverse, world(other.affine, [0, 1, 2].map(b => +(b === axis))))
      .map((value, a) => value - origin[a]));
    const askew = steps.some((step, axis) => step.some((v, a) => a !== axis && Math.abs(v) * other.shape[axis] > 0.5));
    return askew ? null : [0, 1, 2].map(a => Int32Array.from({length: other.shape[a]}, (_, i) => {
      const index = Math.round(origin[a] + i * steps[a][a]);
      return index < 0 || index >= this.shape[a] ? -1 : index;
    }));
  }

  at(index) {
    return index.includes(-1) ? EMPTY : this.data[index[0] + this.shape[0] * (index[1] + this.shape[1] * index[2])];
  }

  /* The HU of a plane as it is shown: rows from the top, the patient's right or anterior on the left. */
  plane({across, x, y}, at, indices) {
    const [wide, high] = [indices[x].length, indices[y].length];
    const strides = [1, this.shape[0], this.shape[0] * this.shape[1]], fixed = indices[across][at];
    const hu = new Int16Array(wide * high).fill(EMPTY);
    for (let row = 0; fixed >= 0 && row < high; row++) {
      const j = indices[y][high - 1 - row];
      for (let column = 0; j >= 0 && column < wide; column++) {
        const i = indices[x][wide - 1 - column];
        if (i >= 0) hu[row * wide + column] = this.data[fixed * strides[across] + j * strides[y] + i * strides[x]];
      }
    }
    return hu;
  }

  /* The largest or mean HU along rays across the body, seen from the front and turned by an angle in degrees. */
  projection(degrees, mean) {
    const step = Math.ceil(Math.max(...this.shape) / 128), [nx, ny, nz] = this.shape, [sx, sy, sz] = this.spacing;
    const pixel = step * Math.min(sx, sy), count = Math.ceil(Math.hypot(nx * sx, ny * sy) / pixel);
    const cos = Math.cos(degrees * Math.PI / 180), sin = Math.sin(degrees * Math.PI / 180);
    const places = new Int32Array(count * count).fill(-1);
    for (let u = 0; u < count; u++) for (let t = 0; t < count; t++) {
      const a = (count / 2 - u - 0.5) * pixel, b = (t + 0.5 - count / 2) * pixel;
      const i = Math.round((a * cos - b * sin) / sx + (nx - 1) / 2);
      const j = Math.round((a * sin + b * cos) / sy + (ny - 1) / 2);
      if (i >= 0 && i < nx && j >= 0 && j < ny) places[u * count + t] = i + nx * j;
    }
    const high = Math.ceil(nz / step), out = new Float32Array(count * high);
    for (let row = 0; row < high; row++) {
      const base = nx * ny * (nz - 1 - row * step);
      for (let u = 0; u < count; u++) {
        let most = -1024, sum = 0;
        for (let t = 0; t < count; t++) {
          const place = places[u * count + t], hu = place < 0 ? -1024 : Math.max(this.data[base + place], -1024);
          if (hu > most) most = hu;
          sum += hu;
        }
        out[row * count + u] = mean ? sum / count : most;
      }
    }
    return {values: out, wide: count, high, ratio: high * step * sz / (count * pixel)};
  }
}
