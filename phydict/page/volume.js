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

  /* Per axis, where another volume's indices lie in this one's, [that of its 0, step]; null where axes are askew. */
  along(other) {
    const origin = world(this.inverse, world(other.affine, [0, 0, 0]));
    const steps = [0, 1, 2].map(axis => world(this.inverse, world(other.affine, [0, 1, 2].map(b => +(b === axis))))
      .map((value, a) => value - origin[a]));
    const askew = steps.some((step, axis) => step.some((v, a) => a !== axis && Math.abs(v) * other.shape[axis] > 0.5));
    return askew ? null : [0, 1, 2].map(a => [origin[a], steps[a][a]]);
  }

  /* Per axis, this volume's nearest index for each index of another's, -1 outside; null where the axes are askew. */
  indices(other) {
    return this.along(other)?.map(([first, step], a) => Int32Array.from({length: other.shape[a]}, (_, i) => {
      const index = Math.round(first + i * step);
      return index < 0 || index >= this.shape[a] ? -1 : index;
    })) ?? null;
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

  /* The largest or mean HU, air at least, in each of the blocks that another volume's extent is cut into, x fastest;
     air where this one has nothing. */
  blocks(over, sides, mean) {
    const kept = this.kept;
    if (kept?.over === over && kept.mean === mean) return kept.values;
    const spans = this.along(over).map(([first, step], a) => Array.from({length: sides[a]}, (_, block) => {
      const [start, end] = [block, block + 1].map(edge => first + step * (edge * over.shape[a] / sides[a] - 0.5));
      const from = Math.ceil(start - 1e-6), to = Math.ceil(end - 1e-6);  // those whose centres lie in the block
      const nearest = Math.round((start + end) / 2), [low, high] = from < to ? [from, to] : [nearest, nearest + 1];
      return [Math.max(low, 0), Math.min(high, this.shape[a])];
    }));
    const [wide, deep] = this.shape, values = new Float32Array(sides[0] * sides[1] * sides[2]);
    let at = 0;
    for (const [z0, z1] of spans[2]) for (const [y0, y1] of spans[1]) for (const [x0, x1] of spans[0]) {
      let most = -1024, sum = 0;
      for (let z = z0; z < z1; z++) for (let y = y0; y < y1; y++) {
        const row = wide * (y + deep * z);
        for (let i = row + x0; i < row + x1; i++) {
          const hu = Math.max(this.data[i], -1024);
          if (hu > most) most = hu;
          sum += hu;
        }
      }
      const count = Math.max(x1 - x0, 0) * Math.max(y1 - y0, 0) * Math.max(z1 - z0, 0);
      values[at++] = mean && count ? sum / count : most;
    }
    this.kept = {over, mean, values};
    return values;
  }

  /* The largest or mean HU along rays across the body, seen from the front and turned by an angle in degrees, over the
     extent of another volume, air outside of this one. */
  projection(degrees, mean, over = this) {
    const [nx, ny, nz] = over.shape.map(size => Math.ceil(size / Math.ceil(size / 128)));
    const [sx, sy, sz] = [nx, ny, nz].map((size, a) => over.spacing[a] * over.shape[a] / size);
    const hu = this.blocks(over, [nx, ny, nz], mean);
    const pixel = Math.min(sx, sy), count = Math.ceil(Math.hypot(nx * sx, ny * sy) / pixel);
    const cos = Math.cos(degrees * Math.PI / 180), sin = Math.sin(degrees * Math.PI / 180);
    const places = new Int32Array(count * count).fill(-1);
    for (let u = 0; u < count; u++) for (let t = 0; t < count; t++) {
      const a = (count / 2 - u - 0.5) * pixel, b = (t + 0.5 - count / 2) * pixel;
      const i = Math.round((a * cos - b * sin) / sx + (nx - 1) / 2);
      const j = Math.round((a * sin + b * cos) / sy + (ny - 1) / 2);
      if (i >= 0 && i < nx && j >= 0 && j < ny) places[u * count + t] = i + nx * j;
    }
    const out = new Float32Array(count * nz);
    for (let row = 0; row < nz; row++) {
      const base = nx * ny * (nz - 1 - row);
      for (let u = 0; u < count; u++) {
        let most = -1024, sum = 0;
        for (let t = 0; t < count; t++) {
          const place = places[u * count + t], value = place < 0 ? -1024 : hu[base + place];
          if (value > most) most = value;
          sum += value;
        }
        out[row * count + u] = mean ? sum / count : most;
      }
    }
    return {values: out, wide: count, high: nz, ratio: nz * sz / (count * pixel)};
  }
}
