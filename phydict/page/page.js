"use strict";
const content = JSON.parse(byId("content").textContent);
const keyOf = case_ => `${case_.record.method}/${case_.record.case}`;
const places = new Map(content.cases.map(case_ => [keyOf(case_), case_]));
const loaded = new Map();  // key -> {volumes, xrays}, the last ones opened
let viewer = null, xrayViewer = null, opened = "";
const KINDS = new Map(Object.entries({
  "volume.nii.gz": "the reconstruction in HU", "coarse.nii.gz": "the reconstruction on coarser voxels, in HU",
  "interval_90.nii.gz": "half of each voxel's 90% interval, in HU",
  "deviation.nii.gz": "standard deviation of each voxel, in HU", "panel.png": "planes and X-rays as one picture",
  "reconstruction.json": "scores, settings and versions", "details.json": "misfits, settings and versions",
  "geometry_found.yaml": "the geometry that was found",
  "slice_features.safetensors": "features of slices, for Frechet distances", "results.csv": "a row per case",
  "results.md": "the tables as Markdown", "tables.md": "the tables as Markdown", "tables.tex": "the tables as LaTeX"}));

/* A value as it is read: numbers to four digits, named parts that are not known left out, those of a list as a dash. */
function words(value, unit = "") {
  if (typeof value === "number") return (Number.isInteger(value) ? value : Number(value.toPrecision(4))) + unit;
  if (value === null) return "–";
  if (typeof value !== "object") return String(value);
  if (Array.isArray(value)) return value.map(part => words(part, unit)).join(", ");
  return Object.entries(value).filter(([, part]) => part !== null).map(
    ([name, part]) => `${name.replaceAll("_", " ")} ${words(part, unit)}`).join(", ");
}

/* A list's line for a file in a folder, with a few words on what it is. */
function fileLine({name, url}, folder = ".") {
  const kind = KINDS.get(name.split("/").at(-1));
  return element("li", {}, element("a", {href: `${folder}/${url}`}, name), kind ? `: ${kind}` : "");
}

/* The rows of a table in the order of a column: numbers by size, text by its letters, what is missing last. */
function inOrder(rows, column, down) {
  const key = row => row[column].value ?? row[column].text;
  const absent = row => row[column].value === null && !row[column].label;
  return [...rows].sort((one, other) => absent(one) - absent(other) || (down ? -1 : 1) * (
    typeof key(one) === "number" && typeof key(other) === "number" ? key(one) - key(other)
      : String(key(one)).localeCompare(String(key(other)), undefined, {numeric: true})));
}

function table(title, header, rows, notes = []) {
  const body = element("tbody"), fill = shown => body.replaceChildren(...shown.map(row => row.made ??= line(row)));
  const heads = header.map((name, column) => {
    const head = element("th", {scope: "col", "aria-sort": "none", class: rows[0]?.[column]?.label ? "text" : null},
      element("button", {type: "button", onclick: () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        for (const other of heads) other.setAttribute("aria-sort", "none");
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        fill(inOrder(rows, column, down));
        linkNeighbours();
      }}, name.replace(/ (?=[↑↓→])/, "\u00a0")));
    return head;
  });
  fill(rows);
  return element("div", {},
    element("div", {class: "scroll", tabindex: 0, role: "region", "aria-label": title}, element("table", {},
      element("caption", {}, title), element("thead", {}, element("tr", {}, ...heads)), body)),
    ...notes.map(note => element("p", {class: "notes"}, note)));
}

function line(cells) {
  return element("tr", {"data-key": cells.key}, ...cells.map((cell, column) => element(column ? "td" : "th", {
    scope: column ? null : "row", class: ["", "best", "second"][cell.place ?? 0] + (cell.label ? " text" : "")},
    cell.node ?? (cell.label ? cell.text : cell.text.replace(" [", "\n[")))));
}

const thumbnail = case_ => case_.files.find(file => file.name === "thumbnail.png");

function caseRow(case_, pictured) {
  const {record, scores} = case_, key = keyOf(case_);
  const open = () => opened === key ? showCase(key) : (location.hash = encodeURIComponent(key));
  const picture = thumbnail(case_), warnings = (record.warnings ?? []).length;
  const row = [
    {text: record.case, value: null, label: true,
     node: element("button", {class: "name", type: "button", onclick: open}, record.case)},
    ...pictured ? [{text: "", value: null, node: picture ? element("img", {
      loading: "lazy", alt: "", src: `${case_.folder}/${picture.url}`, onclick: open}) : ""}] : [],
    {text: record.method, value: null, label: true},
    {text: String(record.views ?? "–"), value: record.views ?? null}];
  for (const {name, decimals} of content.measures) {
    const value = scores[name] ?? null;
    row.push({text: value === null ? "–" : value.toFixed(decimals), value, place: case_.places[name]});
    if (name === "seconds") row.push({text: String(warnings), value: warnings});
  }
  row.key = key;
  return row;
}

/* Seconds against error, a dot each, coloured by its series; null where there is nothing to see. */
function plot(points, error) {
  const known = points.filter(point => point.seconds > 0 && point.error !== null);
  if (known.length < 2) return null;
  const svg = (tag, attributes, ...children) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  };
  const range = values => [Math.min(...values), Math.max(...values)];
  const [first, last] = range(known.map(point => Math.log10(point.seconds)));
  const [low, high] = range(known.map(point => point.error));
  const x = seconds => 80 + 320 * share(Math.log10(seconds), first, last === first ? first + 1 : last);
  const y = value => 250 - 210 * share(value, low, high === low ? low + 1 : high);
  const series = [...new Set(known.map(point => point.series))];
  const colour = name => `hsl(${Math.round(360 * series.indexOf(name) / series.length)} 65% 50%)`;
  const text = (label, left, top, anchor) => svg("text", {x: left, y: top, "text-anchor": anchor}, label);
  const ticks = values => [...new Set(values.map(value => words(value)))];
  const label = `Seconds per case against ${error}`;
  return element("figure", {}, element("figcaption", {}, `${label}; lower left is better`),
    element("div", {class: "scroll", tabindex: 0, role: "region", "aria-label": label},
      svg("svg", {viewBox: "0 0 620 310"},
        svg("line", {x1: 70, y1: 260, x2: 410, y2: 260}), svg("line", {x1: 70, y1: 30, x2: 70, y2: 260}),
        text(error, 8, 18, "start"), text("seconds, logarithmic", 240, 296, "middle"),
        ...ticks([10 ** first, 10 ** last]).map((tick, n) => text(tick, 80 + 320 * n, 278, "middle")),
        ...ticks([low, high]).map((tick, n) => text(tick, 65, 254 - 210 * n, "end")),
        ...known.map(point => svg("circle", {
          cx: x(point.seconds), cy: y(point.error), r: 4, fill: colour(point.series), role: "img"},
          svg("title", {}, `${point.name}: ${words(point.seconds)} s, ${words(point.error)}`))),
        ...series.slice(0, 17).map((name, n) => svg("g", {}, text(name, 436, 34 + 15 * n, "start"),
          svg("circle", {cx: 426, cy: 30 + 15 * n, r: 4, fill: colour(name)}))),
        ...series.length > 17 ? [text(`and ${series.length - 17} more`, 436, 289, "start")] : [])));
}

function showRun() {
  const {title, version, tables, cases, measures, points, error, plots, links} = content, run = byId("run");
  byId("title").textContent = title;
  byId("made").textContent = `Made by phydict ${version}.`;
  run.append(...tables.map(made => table(made.title, made.header, made.rows.map(row => {
    row[0].label = true;
    return row;
  }), made.notes)), plot(points, error) ?? "");
  if (cases.length) {
    const pictured = cases.some(thumbnail);
    const header = ["case", ...pictured ? ["picture"] : [], "method", "views", ...measures.flatMap(
      ({name, heading}) => name === "seconds" ? [heading, "warnings"] : [heading])];
    const rows = cases.map(case_ => caseRow(case_, pictured)), none = element("p", {role: "status"});
    const caseTable = table("Cases", header, rows, [
      "Best of each case by equal X-rays and voxels in bold, second underlined. A name opens the case."]);
    const filter = element("input", {type: "search", oninput: () => {
      const wanted = filter.value.toLowerCase().trim().split(/\s+/);
      const lines = [...caseTable.querySelectorAll("tbody tr")];
      for (const row of lines) row.hidden = !wanted.every(word => row.dataset.key.toLowerCase().includes(word));
      none.textContent = lines.every(row => row.hidden) ? "none found" : "";
      linkNeighbours();
    }});
    run.append(element("section", {id: "cases", "aria-label": "Cases"},
      element("p", {}, element("label", {}, "show cases and methods with ", filter)), caseTable, none));
  }
  run.append(
    ...plots.map(({name, url}) => element("p", {},
      element("img", {class: "plot", loading: "lazy", alt: name, src: url}))),
    element("ul", {}, ...links.map(link => fileLine(link))));
}

/* The volumes and X-rays that a case's script holds. */
async function unpacked(data) {
  const volumes = {}, xrays = data["X-rays"] ?? null;
  for (const [name, text] of Object.entries(data.volumes))
    volumes[name] = new Volume(name, await unpack(text, Int16Array), data);
  for (const name of xrays ? ["measured", "rendered"] : []) xrays[name] = await unpack(xrays[name], Uint16Array);
  return {volumes, xrays};
}

/* Why a case is not shown: its script, or else this browser. */
const because = error => error.ofFile ? error.message : `this browser cannot show it, since ${error.message}`;

/* A case's volumes and X-rays; the last few opened are kept. */
async function load(case_) {
  const key = keyOf(case_);
  if (!loaded.has(key)) {
    if (!window.DecompressionStream) throw new Error("it does not know DecompressionStream");
    const script = element("script", {src: `${case_.folder}/view.js`});
    try {
      const data = await new Promise((resolve, reject) => {
        script.onload = () => script.data ? resolve(script.data) : reject(new Error("it is damaged"));
        script.onerror = () => reject(new Error("it is missing"));
        document.head.append(script);
      }).finally(() => script.remove());
      loaded.set(key, await unpacked(data));
    } catch (error) {
      throw error instanceof RangeError ? error  // too little memory
        : Object.assign(new Error(`${case_.folder}/view.js cannot be used, since ${error.message}`), {ofFile: true});
    }
    if (loaded.size > 4) loaded.delete(loaded.keys().next().value);
  }
  return loaded.get(key);
}
window.phydictView = data => { document.currentScript.data = data; };

/* Leads from the open case to those before and behind it, as the table is sorted and searched. */
function linkNeighbours() {
  const rows = [...document.querySelectorAll("tr[data-key]:not([hidden])")].map(row => row.dataset.key);
  for (const [id, step] of [["previous", -1], ["next", 1]]) {
    const to = rows[rows.indexOf(opened) + step] ?? "";
    byId(id).hidden = !to;
    byId(id).title = to;
    byId(id).href = `#${encodeURIComponent(to)}`;
  }
}

async function showCase(key) {
  const case_ = places.get(key);
  byId("case").hidden = !case_;
  opened = key;
  for (const row of document.querySelectorAll("tr[data-key]"))
    row.setAttribute("aria-current", row.dataset.key === key);
  if (!case_) {
    if (key === "cases") byId("cases")?.scrollIntoView();
    return;
  }
  linkNeighbours();
  const {record, scores, folder, files} = case_;
  byId("case-name").textContent = `${record.case}: ${record.method}`;
  byId("case-scores").textContent = content.measures.filter(({name}) => (scores[name] ?? null) !== null)
    .map(({name, label, decimals}) => `${label} ${scores[name].toFixed(decimals)}`).join(", ");
  byId("warnings").replaceChildren(...(record.warnings ?? []).map(text => element("li", {}, text)));
  byId("report").textContent = record.report || "none was given";
  byId("report").parentNode.hidden = !("report" in record);
  const linked = files.filter(({name}) => !["view.js", "thumbnail.png"].includes(name));
  byId("files").replaceChildren(...linked.map(file => fileLine(file, folder)));
  byId("files").parentNode.hidden = !linked.length;
  const {settings, versions, grid, report, warnings, scores: _, files: __, ...facts} = record;
  byId("facts").replaceChildren(...Object.entries({voxels: grid?.shape?.join(" x "), ...facts})
    .filter(([, value]) => (value ?? null) !== null).flatMap(([name, value]) => [
      element("dt", {}, name.replaceAll("_", " ")),
      element("dd", {}, words(value, name.startsWith("seconds") ? " s" : ""))]));
  const kept = JSON.stringify({settings: content.shared[settings] ?? undefined,
                               versions: content.shared[versions] ?? undefined}, null, 1);
  byId("settings").textContent = kept.replace(/\[\n[^"[\]{}]*\]/g, list =>  // numbers on one line
    list.replace(/,\n\s*/g, ", ").replace(/\n\s*/g, ""));
  byId("settings").hidden = kept === "{}";
  const focused = document.activeElement;
  byId("viewer").hidden = true;
  byId("state").textContent = folder ? "loading the volume"
    : "No volume of this run was kept: ablate --keep_volumes keeps them.";
  try {
    if (!folder) return;
    const {volumes, xrays} = await load(case_);
    if (opened !== key) return;
    byId("viewer").hidden = false;
    viewer ??= new Viewer();
    viewer.show(volumes, record.case);
    xrayViewer ??= new XrayViewer();
    xrayViewer.show(xrays, record.misfit_per_view ?? []);
    await offerOthers(case_, volumes);
  } catch (error) {
    if (opened === key) byId("state").textContent = `The volume is not shown: ${because(error)}.` + (error.ofFile
      ? " Delete it and make the page anew, without truth and X-rays: infer.py page <folder>." : "");
  } finally {
    if (opened === key && [focused, document.body].includes(document.activeElement)) {  // the reader went nowhere else
      byId("case-name").focus({preventScroll: true});
      byId("case").scrollIntoView();
    }
  }
}

/* Fills the choice of what stands beside a case's volume: its truth, and the same case by other methods. */
async function offerOthers(case_, volumes) {
  const same = content.cases.filter(
    other => other !== case_ && other.folder && other.record.case === case_.record.case);
  const choices = [["nothing", null], ...volumes.truth ? [["truth", volumes.truth]] : [],
                   ...same.map(other => [other.record.method, other])];
  byId("other").replaceChildren(...choices.map(([name], n) => element("option", {value: n}, name)));
  byId("other").value = volumes.truth ? 1 : 0;
  const choose = async () => {
    const value = byId("other").value, [name, chosen] = choices[value];
    let other = chosen, problem = "";
    if (chosen?.record) try {
      other = Object.assign(Object.create(Volume.prototype), (await load(chosen)).volumes.reconstruction, {name});
    } catch (error) {
      [other, problem] = [null, because(error)];
    }
    if (opened !== keyOf(case_) || byId("other").value !== value) return;
    if (!viewer.compare(other)) problem = "it lies askew to this one";
    byId("state").textContent = problem && `The volume of ${name} is not shown beside this one: ${problem}.`;
  };
  byId("other").onchange = choose;
  await choose();
}

showRun();
function follow() {
  let key = "";  // of an address that is none
  try { key = decodeURIComponent(location.hash.slice(1)); } catch {}
  showCase(key);
}
window.addEventListener("hashchange", follow);
if (!location.hash && content.cases.length === 1) location.hash = encodeURIComponent(keyOf(content.cases[0]));
else follow();
