/* Draws the figures of a page from the JSON in it (figure_data.py): uPlot has axes, scales, zoom and cursor, this file
 * paints the layers of a chart (charts.py) between them, and adds switches, readings, a map that turns, sorted tables
 * and links from findings to rows. Nothing is loaded from elsewhere. */
"use strict";
(() => {
  const figures = JSON.parse(document.getElementById("figures").textContent).figures;
  const PT = 96 / 72; // CSS pixels of a point
  const FONT = '11px "Helvetica Neue", Helvetica, Arial, "Liberation Sans", sans-serif';
  const QUIET = "#8a8f98", INK = "#22262b", MARK = "#b3261e", STEPS = 32;
  const MAPS = {
    cividis_r: ["#fee838", "#dac55c", "#b5a36e", "#938578", "#757575", "#576572", "#3b4f6d", "#123570", "#00224e"],
    PuOr: ["#7f3b08", "#b35806", "#e08214", "#fdb863", "#f7f7f7", "#b2abd2", "#8073ac", "#542788", "#2d004b"],
  };
  const HELP = "Drag to zoom, shift and drag to move, ctrl and wheel to zoom, double click to go back. "
    + "Keys: ← → read, shift ← → move, + − zoom, 0 back.";
  const PRINT_WIDTH = 655; // CSS pixels between the margins of A4
  const LINKED_SIZE = 46; // CSS pixels of the y axes of figures whose cursors are linked
  const WIDTH = 210, SMALL_WIDTH = 125; // least width of a panel, and of one that shares the labels of both axes
  const NEAR = 24; // CSS pixels within which the pointer reads a point
  const hidden = new Set(); // switches that are off
  const marked = { rows: new Set(), file: "" }; // rows that a finding names, and their file, if it names one
  const isMarked = (row, file) => marked.rows.has(row) && (!marked.file || !file || marked.file === file);
  const drawn = [];
  let printing = false;
  const darkness = matchMedia("(prefers-color-scheme: dark)");
  const dark = () => darkness.matches && !printing;

  // numbers

  // a packed array (figure_data.py) as numbers
  function unpacked(packed) {
    const bytes = Uint8Array.from(atob(packed.f4 || packed.u2 || ""), letter => letter.charCodeAt(0));
    if (packed.u2 === undefined) return Object.assign(new Float32Array(bytes.buffer), { shape: packed.shape });
    return Float32Array.from(new Uint16Array(bytes.buffer), step => packed.low + packed.step * step);
  }
  // a figure whose arrays stand where they are used
  function resolved(chart) {
    const arrays = chart.arrays.map(unpacked);
    const filled = value => {
      if (!value || typeof value !== "object") return value;
      if (value.array !== undefined) return arrays[value.array];
      if (value.float !== undefined) return value.float === "nan" ? NaN : value.float === "inf" ? Infinity : -Infinity;
      if (Array.isArray(value)) return value.map(filled);
      return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, key === "arrays" ? null : filled(item)]));
    };
    return filled(chart);
  }
  function rounded(value) {
    if (value === null || value === undefined || Number.isNaN(value)) return "–";
    if (value === 0) return "0";
    const size = Math.abs(value);
    return size < 1e-3 || size >= 1e5 ? value.toExponential(3) : String(+value.toPrecision(5));
  }
  const SUPERSCRIPT = "⁰¹²³⁴⁵⁶⁷⁸⁹";
  function tick(value) {
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (size > 0.99e-3 && size < 0.99e5) return String(+value.toPrecision(6));
    const [digits, power] = value.toExponential(0).split("e");
    const raised = [...String(+power)].map(d => (d === "-" ? "⁻" : SUPERSCRIPT[+d])).join("");
    return digits === "1" ? "10" + raised : digits === "-1" ? "-10" + raised : digits + "·10" + raised;
  }
  function rgb(code) { return [1, 3, 5].map(k => parseInt(code.slice(k, k + 2), 16)); }
  function hex(parts) { return "#" + parts.map(p => Math.round(p).toString(16).padStart(2, "0")).join(""); }
  function shade(name, share) {
    const stops = MAPS[name] || MAPS.cividis_r, at = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
    const k = Math.min(Math.floor(at), stops.length - 2), a = rgb(stops[k]), b = rgb(stops[k + 1]);
    return hex(a.map((p, i) => p + (at - k) * (b[i] - p)));
  }
  // a colour of print, light enough on dark paper
  function ink(code) {
    if (!dark() || code[0] !== "#") return code;
    const parts = rgb(code), light = (0.3 * parts[0] + 0.59 * parts[1] + 0.11 * parts[2]) / 255;
    if (code === "#ffffff") return "#1b1e22";
    return light < 0.45 ? hex(parts.map(p => p + (255 - p) * (0.62 - light * 0.4))) : code;
  }

  // layers: length, what they show along the axes, painting, reading

  function prepared(layer) {
    for (const key of ["x", "y", "values", "spread", "counts", "edges"]) {
      if (!(key in layer)) continue;
      const shape = layer[key].shape;
      if (key === "values" && layer.layer === "Heat") layer.shape = shape || [layer[key].length, layer[key][0].length];
      if (typeof layer[key] === "number") layer[key] = [layer[key]];
      if (layer.layer === "Heat" && !shape) layer[key] = layer[key].flatMap(row => [...row]);
    }
    if (layer.layer === "Line") {
      layer.sorted = layer.form === "-" || layer.form === "--";
      for (let i = 1; layer.sorted && i < layer.x.length; i++) if (!(layer.x[i] >= layer.x[i - 1])) layer.sorted = false;
    }
    if (layer.layer === "Dots") {
      layer.order = Array.from(layer.values.keys()).sort((a, b) => layer.values[a] - layer.values[b]);
    }
    if (layer.layer === "Box") {
      const sorted = Array.from(layer.values).sort((a, b) => a - b);
      layer.quantiles = [0.05, 0.25, 0.5, 0.75, 0.95].map(share => {
        const at = share * (sorted.length - 1), k = Math.floor(at), next = sorted[Math.min(k + 1, sorted.length - 1)];
        return sorted[k] + (at - k) * (next - sorted[k]);
      });
    }
    return layer;
  }
  function heatLimits(layer) {
    const [low, high] = layer.limits || [0, null];
    if (high !== null) return [low, high];
    return [low, layer.values.reduce((most, v) => (v > most ? v : most), low)];
  }
  function extent(layer) {
    const [rows, columns] = layer.shape;
    return layer.extent || [-0.5, columns - 0.5, rows - 0.5, -0.5];
  }
  const ends = (values, spread, sign) => Array.from(values, (v, i) => v + sign * (spread ? spread[i] || 0 : 0));
  function content(layer) {
    switch (layer.layer) {
      case "Line": return [layer.x, [...ends(layer.y, layer.spread, -1), ...ends(layer.y, layer.spread, 1)]];
      case "Bars": {
        const along = [-0.5, layer.values.length - 0.5];
        const values = [...ends(layer.values, layer.spread, -1), ...ends(layer.values, layer.spread, 1), layer.base];
        return layer.upright ? [along, values] : [values, along];
      }
      case "Level": return layer.upright ? [[layer.at], []] : [[], [layer.at]];
      case "Dots": return [layer.x, layer.y];
      case "Heat": { const [l, r, b, t] = extent(layer); return [[l, r], [b, t]]; }
      case "Histogram": return [layer.edges, [...layer.counts, 0]];
      case "Box": return [layer.values, [layer.position - 0.5, layer.position + 0.5]];
      default: return [[], []];
    }
  }
  function shown(layer) { return !layer.off && !(layer.switch && hidden.has(layer.switch)); }

  const painters = {
    Line(c, layer, at) {
      const { x, y } = layer, n = x.length;
      c.strokeStyle = c.fillStyle = ink(layer.colour);
      c.lineWidth = Math.max(layer.width * PT, 0.8);
      if (layer.spread) {
        c.beginPath();
        for (let i = 0; i < n; i++) {
          if (!Number.isFinite(layer.spread[i])) continue;
          c.moveTo(at.x(x[i]), at.y(y[i] - layer.spread[i]));
          c.lineTo(at.x(x[i]), at.y(y[i] + layer.spread[i]));
        }
        c.stroke();
      }
      const style = layer.form.replace(/[o.s+]/g, ""), marker = layer.form.replace(/[-:]/g, "");
      if (style) {
        c.setLineDash(style === "--" ? [5, 3] : style === ":" ? [1.5, 3] : []);
        c.beginPath();
        if (layer.sorted) sortedPath(c, x, y, at); else plainPath(c, x, y, at);
        c.stroke();
        c.setLineDash([]);
      }
      if (!marker) return;
      const radius = layer.size * PT / (marker === "." ? 4 : 2);
      for (let i = 0; i < n; i++) {
        const px = at.x(x[i]), py = at.y(y[i]);
        if (!at.inside(px, py)) continue;
        if (marker === "+") { cross(c, px, py, radius); continue; }
        c.beginPath();
        if (marker === "s") c.rect(px - radius, py - radius, 2 * radius, 2 * radius); else c.arc(px, py, radius, 0, 6.3);
        if (layer.hollow) { c.fillStyle = ink("#ffffff"); c.fill(); c.lineWidth = 1; c.stroke(); } else c.fill();
      }
    },
    Bars(c, layer, at) {
      const half = layer.thick / 2, along = layer.upright ? at.y : at.x, across = layer.upright ? at.x : at.y;
      for (let i = 0; i < layer.values.length; i++) {
        const colour = typeof layer.colours === "string" ? layer.colours : layer.colours[i], place = i + layer.shift;
        const from = along(layer.base), to = along(layer.values[i]);
        const a = across(place - half), b = across(place + half);
        c.fillStyle = ink(colour);
        if (layer.upright) c.fillRect(Math.min(a, b), Math.min(from, to), Math.abs(b - a), Math.abs(to - from));
        else c.fillRect(Math.min(from, to), Math.min(a, b), Math.abs(to - from), Math.abs(b - a));
        if (!layer.spread) continue;
        const low = along(layer.values[i] - layer.spread[i]), high = along(layer.values[i] + layer.spread[i]);
        c.strokeStyle = ink(MARK); c.lineWidth = 1.2; c.beginPath();
        if (layer.upright) { c.moveTo(across(place), low); c.lineTo(across(place), high); }
        else { c.moveTo(low, across(place)); c.lineTo(high, across(place)); }
        c.stroke();
      }
    },
    Level(c, layer, at) {
      c.strokeStyle = c.fillStyle = ink(layer.colour); c.lineWidth = 1.1;
      c.setLineDash(layer.form === "--" ? [5, 2.5] : layer.form === ":" ? [1.5, 2.5] : []);
      c.beginPath();
      const place = layer.upright ? at.x(layer.at) : at.y(layer.at);
      if (layer.upright) { c.moveTo(place, at.top); c.lineTo(place, at.bottom); }
      else { c.moveTo(at.left, place); c.lineTo(at.right, place); }
      c.stroke(); c.setLineDash([]);
      if (!layer.text) return;
      if (!layer.upright) { written(c, layer.text, at.left + 4, place - 4, layer.colour); return; }
      const right = place < at.left + 0.6 * (at.right - at.left);
      const y = at.bottom - layer.height * (at.bottom - at.top) + 10;
      written(c, layer.text, place + (right ? 4 : -4), y, layer.colour, right ? "left" : "right");
    },
    Label(c, layer, at) {
      const y = at.y(layer.y) - layer.offset[1] * PT + (layer.along === "center" ? 4 : 0);
      written(c, layer.text, at.x(layer.x) + layer.offset[0] * PT, y, layer.colour, layer.across);
    },
    Dots(c, layer, at) {
      c.lineWidth = 0.4; c.strokeStyle = ink(QUIET);
      for (const i of layer.order) {
        c.fillStyle = shade("cividis_r", (layer.values[i] - layer.low) / (layer.high - layer.low || 1));
        c.beginPath(); c.arc(at.x(layer.x[i]), at.y(layer.y[i]), 3, 0, 6.3); c.fill(); c.stroke();
      }
    },
    Heat(c, layer, at) {
      const [rows, columns] = layer.shape, [left, right, bottom, top] = extent(layer), [low, high] = heatLimits(layer);
      for (let i = 0; i < rows; i++) for (let j = 0; j < columns; j++) {
        const value = layer.values[i * columns + j];
        if (!Number.isFinite(value)) continue;
        const xs = [j, j + 1].map(k => at.x(left + (right - left) * k / columns));
        const ys = [i, i + 1].map(k => at.y(top + (bottom - top) * k / rows));
        c.fillStyle = shade(layer.colours, (value - low) / (high - low || 1));
        c.fillRect(Math.min(...xs), Math.min(...ys), Math.abs(xs[1] - xs[0]) + 0.5, Math.abs(ys[1] - ys[0]) + 0.5);
        if (layer.written) {
          c.fillStyle = Math.abs(value) <= 0.6 ? INK : "#ffffff"; c.textAlign = "center";
          c.fillText(value.toFixed(2), (xs[0] + xs[1]) / 2, (ys[0] + ys[1]) / 2 + 3);
        }
      }
    },
    Histogram(c, layer, at) {
      c.fillStyle = ink(layer.colour); c.globalAlpha = 0.9;
      for (let i = 0; i < layer.counts.length; i++) {
        const a = at.x(layer.edges[i]), b = at.x(layer.edges[i + 1]), top = at.y(layer.counts[i]);
        c.fillRect(a, top, b - a, at.y(0) - top);
      }
      c.globalAlpha = 1;
    },
    Box(c, layer, at) {
      const [low, first, median, third, high] = layer.quantiles.map(at.x);
      const y = at.y(layer.position), top = at.y(layer.position - 0.28), bottom = at.y(layer.position + 0.28);
      c.strokeStyle = c.fillStyle = ink(QUIET); c.lineWidth = 1.2; c.beginPath();
      c.moveTo(low, y); c.lineTo(high, y); c.stroke();
      for (const value of layer.values) if (value < layer.quantiles[0] || value > layer.quantiles[4]) {
        c.beginPath(); c.arc(at.x(value), y, 1.2, 0, 6.3); c.fill();
      }
      c.fillStyle = ink(layer.colour);
      c.fillRect(first, Math.min(top, bottom), third - first, Math.abs(bottom - top));
      c.strokeStyle = "#ffffff"; c.lineWidth = 1.8; c.beginPath();
      c.moveTo(median, top); c.lineTo(median, bottom); c.stroke();
    },
  };
  function cross(c, x, y, r) {
    c.lineWidth = 1.1; c.beginPath(); c.moveTo(x - r, y); c.lineTo(x + r, y); c.moveTo(x, y - r); c.lineTo(x, y + r); c.stroke();
  }
  function written(c, words, x, y, colour, across = "left") {
    c.textAlign = across; c.lineWidth = 3; c.strokeStyle = ink("#ffffff"); c.lineJoin = "round";
    c.strokeText(words, x, y); c.fillStyle = ink(colour); c.fillText(words, x, y);
  }
  function plainPath(c, x, y, at) {
    let pen = false;
    for (let i = 0; i < x.length; i++) {
      const px = at.x(x[i]), py = at.y(y[i]);
      if (!Number.isFinite(px + py)) { pen = false; continue; }
      if (pen) c.lineTo(px, py); else c.moveTo(px, py);
      pen = true;
    }
  }
  // first index whose x is not below a value
  function firstAt(x, value) {
    let low = 0, high = x.length;
    while (low < high) { const middle = (low + high) >> 1; if (x[middle] < value) low = middle + 1; else high = middle; }
    return low;
  }
  // of a curve with rising x: what is in view; of each column of pixels the smallest and the largest value
  function sortedPath(c, x, y, at) {
    const begin = Math.max(firstAt(x, at.low) - 1, 0), end = Math.min(firstAt(x, at.high) + 1, x.length);
    if (end - begin < 4 * (at.right - at.left)) { plainPath(c, x.subarray ? x.subarray(begin, end) : x.slice(begin, end), y.subarray ? y.subarray(begin, end) : y.slice(begin, end), at); return; }
    let column = NaN, low = 0, high = 0, pen = false;
    const stroke = () => { if (pen) c.lineTo(column, low); else c.moveTo(column, low); c.lineTo(column, high); pen = true; };
    for (let i = begin; i < end; i++) {
      const px = Math.round(at.x(x[i])), py = at.y(y[i]);
      if (!Number.isFinite(py)) continue;
      if (px !== column) { if (!Number.isNaN(column)) stroke(); column = px; low = high = py; }
      else { if (py < low) low = py; if (py > high) high = py; }
    }
    stroke();
  }

  // a panel: a uPlot whose layers are painted here

  class Panel {
    constructor(figure, panel, number, box) {
      Object.assign(this, { figure, panel, number, box });
      this.layers = panel.layers;
      this.title = document.createElement("p");
      this.title.className = "panel-title";
      this.title.textContent = panel.title;
      this.reading = document.createElement("span");
      this.reading.className = "reading";
      box.append(this.title, this.reading);
      box.tabIndex = 0;
      box.setAttribute("role", "group");
      box.setAttribute("aria-label", `${panel.title || panel.y || figure.chart.title}. ${this.range()} ${HELP}`);
      box.addEventListener("keydown", event => this.key(event));
      this.home = [this.limits("x"), this.limits("y")];
    }
    // what a screen reader says of the values
    range() {
      return this.layers.filter(layer => layer.label && layer.y).map(layer => {
        let low = Infinity, high = -Infinity;
        for (const v of layer.y) { if (v < low) low = v; if (v > high) high = v; }
        return `${layer.label}: ${rounded(low)} to ${rounded(high)}.`;
      }).join(" ");
    }
    names(letter) { return this.panel[letter + "names"] ? this.panel[letter + "names"] : null; }
    limits(letter) {
      const names = this.names(letter), stated = this.panel[letter + "lim"];
      if (names) return [-0.6, names.length - 0.4];
      if (stated) return stated.slice();
      let low = Infinity, high = -Infinity;
      for (const layer of this.layers) for (const v of content(layer)[letter === "x" ? 0 : 1]) {
        if (v < low) low = v; if (v > high) high = v;
      }
      if (!(high >= low)) return [0, 1];
      const heat = this.layers.some(layer => layer.layer === "Heat");
      const margin = heat ? 0 : 0.05 * (high - low) || 0.5 * Math.abs(high) || 0.5;
      return [low - margin, high + margin];
    }
    scale(letter) {
      const panel = this.panel, log = panel.log.includes(letter);
      const symlog = letter === "y" && panel.symlog;
      const turned = letter === "y" && (this.names("y") || this.layers.some(layer => layer.layer === "Heat"));
      const scale = { time: false, auto: false, dir: turned ? -1 : 1, range: (u, low, high) => [low, high] };
      if (log) Object.assign(scale, { distr: 3 });
      if (symlog) Object.assign(scale, { distr: 4, asinh: symlog });
      return scale;
    }
    axis(letter) {
      const names = this.names(letter), panel = this.panel;
      const upright = letter === "x" && names && !names.some(name => name.includes("\n"));
      const axis = {
        font: FONT, labelFont: FONT, stroke: () => ink(INK), label: this.bare(letter) ? undefined : panel[letter] || undefined, labelSize: 16, labelGap: 2,
        grid: { show: panel.grid === letter || panel.grid === "both", stroke: () => (dark() ? "#3a3f46" : "#e3e5e8"), width: 1 },
        ticks: { stroke: () => ink(QUIET), width: 1, size: 4 }, border: { show: true, stroke: () => ink(QUIET), width: 1 },
        gap: 3, space: letter === "x" ? 55 : 26,
      };
      // names of no more letters than fit
      const longest = names ? Math.max(...names.map(name => Math.max(...name.split("\n").map(t => t.length)))) : 0;
      if (names) {
        axis.splits = (u, k, low, high) => names.map((_, i) => i).filter(i => i >= low && i <= high);
        axis.values = (u, splits) => splits.map(i => (upright || letter === "y" ? names[i].replace(/\n/g, " ") : names[i]));
        axis.rotate = upright && longest * names.length > 60 ? -90 : 0;
        axis.size = letter === "y" || axis.rotate ? Math.min(10 + 6 * longest, letter === "y" ? 190 : 120) : 18 + 12 * Math.max(...names.map(n => n.split("\n").length - 1));
        if (letter === "x") axis.space = 1; else axis.space = 1;
      } else {
        axis.values = (u, splits) => splits.map(value => (value === null ? null : tick(value)));
        if (this.bare(letter)) axis.values = (u, splits) => splits.map(() => "");
        if (letter === "y" && this.figure.link) axis.size = LINKED_SIZE;
        else if (letter === "y") axis.size = (u, values) => 12 + 6.2 * Math.max(1, ...(values || []).map(v => (v || "").length));
        else axis.size = this.bare(letter) ? 8 : 22;
        if (panel.log.includes(letter)) { axis.splits = (u, k, low, high) => logTicks(low, high, letter === "x" ? 7 : 6); axis.filter = (u, splits) => splits; }
        else if (panel.symlog && letter === "y") { axis.splits = (u, k, low, high) => symlogTicks(low, high, panel.symlog); axis.filter = (u, splits) => splits; }
      }
      return axis;
    }
    build(width, height) {
      const link = this.figure.link;
      const options = {
        width, height, pxAlign: 0, legend: { show: false }, pxRatio: Math.max(2, devicePixelRatio || 1),
        scales: { x: this.scale("x"), y: this.scale("y") }, series: [{}, { show: true, points: { show: false } }],
        axes: [this.axis("x"), this.axis("y")], padding: [6, this.barred() ? 52 : 10, 0, 0],
        cursor: {
          drag: { x: true, y: !link, uni: 20 }, points: { show: false }, y: !link,
          sync: link ? { key: link, scales: ["x", null] } : undefined,
          bind: { dblclick: () => () => this.figure.back(this), mousedown: (u, target, handler) => event => (event.shiftKey ? this.move(event) : handler(event)) },
        },
        hooks: { draw: [u => this.paint(u)], setCursor: [u => this.read(u)], setScale: [(u, key) => this.scaled(key)] },
      };
      if (this.plot) this.plot.destroy();
      this.quiet = true;
      this.plot = new uPlot(options, [[...this.home[0]], [null, null]], this.box);
      this.fit();
      this.plot.root.addEventListener("wheel", event => this.wheel(event), { passive: false });
      this.plot.root.addEventListener("mouseleave", () => hideTip());
      this.back();
      this.quiet = false;
    }
    // whether another panel of the grid has the labels of the axis
    bare(letter) {
      const { chart, columns, shownPanels } = this.figure, k = shownPanels.indexOf(this);
      if (!chart.shared.includes(letter)) return false;
      return letter === "x" ? k + columns < shownPanels.length : k % columns > 0;
    }
    barred() { return this.layers.some(layer => layer.layer === "Heat" || (layer.layer === "Dots" && layer.unit)); }
    // the same scale of both axes
    fit() {
      if (!this.panel.equal && !this.layers.some(layer => layer.extent)) return;
      const { width, height } = this.plot.bbox, home = [this.limits("x"), this.limits("y")];
      const unit = Math.max((home[0][1] - home[0][0]) / width, Math.abs(home[1][1] - home[1][0]) / height);
      this.home = home.map(([low, high], k) => {
        const middle = (low + high) / 2, half = unit * (k ? height : width) / 2;
        return [middle - half, middle + half];
      });
    }
    back() { this.view(...this.home); }
    view(x, y) {
      this.plot.batch(() => {
        if (x) this.plot.setScale("x", { min: Math.min(...x), max: Math.max(...x) });
        if (y) this.plot.setScale("y", { min: Math.min(...y), max: Math.max(...y) });
      });
    }
    range_of(key) { const scale = this.plot.scales[key]; return [scale.min, scale.max]; }
    scaled(key) {
      if (key === "x" && this.plot) this.figure.wholeFor(this);
      if (this.quiet || key !== "x" || !this.figure.link) return;
      const range = this.range_of("x");
      for (const other of linked(this.figure.link)) if (other !== this) {
        other.quiet = true; other.view(range, null); other.quiet = false;
      }
    }
    // zoom about a share of the view (0 … 1); factor below one: nearer
    zoom(factor, shares = [0.5, 0.5]) {
      const next = ["x", "y"].map((key, k) => {
        if (k === 1 && this.figure.link) return null;
        const values = this.range_of(key), log = this.plot.scales[key].distr === 3;
        const [low, high] = log ? values.map(Math.log10) : values, middle = low + shares[k] * (high - low);
        const range = [middle - factor * (middle - low), middle + factor * (high - middle)];
        return log ? range.map(v => 10 ** v) : range;
      });
      this.view(...next);
    }
    shift(dx, dy = 0) {
      const next = ["x", "y"].map((key, k) => {
        const values = this.range_of(key), log = this.plot.scales[key].distr === 3;
        const [low, high] = log ? values.map(Math.log10) : values, step = (k ? dy : dx) * (high - low);
        return log ? [10 ** (low + step), 10 ** (high + step)] : [low + step, high + step];
      });
      this.view(next[0], this.figure.link ? null : next[1]);
    }
    wheel(event) {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      const box = this.plot.over.getBoundingClientRect();
      const along = (event.clientX - box.left) / box.width, up = 1 - (event.clientY - box.top) / box.height;
      this.zoom(event.deltaY > 0 ? 1.25 : 0.8, [along, this.plot.scales.y.dir < 0 ? 1 - up : up]);
    }
    move(event) {
      event.preventDefault();
      const box = this.plot.over.getBoundingClientRect();
      let last = [event.clientX, event.clientY];
      const dragged = next => {
        const down = (next.clientY - last[1]) / box.height;
        this.shift((last[0] - next.clientX) / box.width, this.plot.scales.y.dir < 0 ? -down : down);
        last = [next.clientX, next.clientY];
      };
      const released = () => { removeEventListener("mousemove", dragged); removeEventListener("mouseup", released); };
      addEventListener("mousemove", dragged); addEventListener("mouseup", released);
    }
    key(event) {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (step && event.shiftKey) this.shift(0.2 * step);
      else if (step) this.walk(step);
      else if (event.key === "+" || event.key === "=") this.zoom(0.7);
      else if (event.key === "-") this.zoom(1 / 0.7);
      else if (event.key === "0" || event.key === "Escape") this.figure.back(this);
      else return;
      event.preventDefault();
    }
    // the keyboard's pointer: a fiftieth of the view further
    walk(step) {
      const box = this.plot.over.getBoundingClientRect(), left = this.plot.cursor.left;
      const next = Math.min(Math.max((left < 0 ? box.width / 2 : left) + step * box.width / 50, 0), box.width - 1);
      this.spoken = true;
      this.plot.setCursor({ left: next, top: this.nearestTop(next) }, true, true);
      this.spoken = false;
    }
    nearestTop(left) {
      const x = this.plot.posToVal(left, "x");
      for (const layer of this.layers) if (layer.layer === "Line" && shown(layer)) {
        let best = 0;
        for (let i = 1; i < layer.x.length; i++) if (Math.abs(layer.x[i] - x) < Math.abs(layer.x[best] - x)) best = i;
        return this.plot.valToPos(layer.y[best], "y");
      }
      return this.plot.over.clientHeight / 2;
    }
    places(u) {
      const ratio = u.pxRatio || uPlot.pxRatio, box = u.bbox;
      const left = box.left / ratio, top = box.top / ratio;
      const x = v => u.valToPos(v, "x") + left, y = v => u.valToPos(v, "y") + top;
      const right = left + box.width / ratio, bottom = top + box.height / ratio, scale = u.scales.x;
      const inside = (px, py) => px >= left - 5 && px <= right + 5 && py >= top - 5 && py <= bottom + 5;
      return { x, y, left, top, right, bottom, inside, low: scale.min, high: scale.max, ratio };
    }
    paint(u) {
      const c = u.ctx, at = this.places(u);
      c.save();
      c.scale(at.ratio, at.ratio);
      c.font = FONT;
      c.textBaseline = "alphabetic";
      c.save();
      c.beginPath(); c.rect(at.left, at.top, at.right - at.left, at.bottom - at.top); c.clip();
      const words = [];
      for (const layer of this.layers) if (shown(layer)) {
        if (layer.layer === "Label" || layer.layer === "Level") words.push(layer); else painters[layer.layer](c, layer, at);
      }
      this.rings(c, at);
      for (const layer of words) painters[layer.layer](c, layer, at);
      c.restore();
      for (const layer of this.layers) if (layer.layer === "Heat") bar(c, layer.colours, ...heatLimits(layer), layer.unit, at.right + 8, at.top, at.bottom);
      else if (layer.layer === "Dots" && layer.unit) bar(c, "cividis_r", layer.low, layer.high, layer.unit, at.right + 8, at.top, at.bottom);
      c.restore();
    }
    // around the points of the rows that a finding names
    rings(c, at) {
      if (!marked.rows.size) return;
      const byRow = this.panel.x === "row" && this.layers[0] ? this.layers[0].x : [];
      const rows = this.figure.points.row || byRow;
      c.strokeStyle = ink(MARK); c.lineWidth = 1.8;
      for (const layer of this.layers) if (layer.x && layer.x.length === rows.length && shown(layer)) {
        for (let i = 0; i < rows.length; i++) if (isMarked(rows[i], this.panel.file || this.figure.fileOf(i))) {
          c.beginPath(); c.arc(at.x(layer.x[i]), at.y(layer.y[i]), 7, 0, 6.3); c.stroke();
        }
      }
    }
    read(u) {
      const { left, top } = u.cursor;
      if (left === undefined || left < 0) { this.reading.textContent = ""; return; }
      const lines = this.readings(left, top);
      this.reading.textContent = lines.length ? lines.join(", ") : "";
      if (this.spoken) this.figure.live.textContent = lines.join(", ");
      const pointed = this.box.matches(":hover");
      if (pointed && lines.length) showTip(u.over, left, top, lines); else if (pointed) hideTip();
    }
    readings(left, top) {
      const u = this.plot, curves = this.layers.filter(layer => layer.sorted && layer.x.length > 1 && shown(layer));
      const x = u.posToVal(left, "x"), y = u.posToVal(top, "y");
      const point = this.nearest(left, top);
      if (point) return this.pointLines(...point);
      if (curves.length) {
        const lines = [`${plainLabel(this.panel.x) || "x"} ${rounded(x)}`];
        for (const layer of curves) {
          const after = Math.min(firstAt(layer.x, x), layer.x.length - 1), before = Math.max(after - 1, 0);
          const i = x - layer.x[before] < layer.x[after] - x ? before : after;
          lines.push(`${layer.label || layer.switch || plainLabel(this.panel.y)} ${rounded(layer.y[i])}`.trim());
        }
        return lines;
      }
      for (const layer of this.layers) if (shown(layer)) {
        const lines = this.areaLines(layer, x, y);
        if (lines) return lines;
      }
      return [];
    }
    nearest(left, top) {
      let best = null, distance = NEAR;
      for (const layer of this.layers) {
        if (!layer.x || layer.sorted || !shown(layer) || (layer.layer === "Line" && layer.x.length < 2)) continue;
        for (let i = 0; i < layer.x.length; i++) {
          const away = Math.hypot(this.plot.valToPos(layer.x[i], "x") - left, this.plot.valToPos(layer.y[i], "y") - top);
          if (away < distance) { distance = away; best = [layer, i]; }
        }
      }
      return best;
    }
    pointLines(layer, i) {
      const names = this.names("x"), lines = [];
      if (layer.label) lines.push(layer.label);
      lines.push(names && names[Math.round(layer.x[i])] !== undefined ? names[Math.round(layer.x[i])].replace(/\n/g, " ") : `${plainLabel(this.panel.x) || "x"} ${rounded(layer.x[i])}`);
      lines.push(`${plainLabel(this.panel.y) || "y"} ${rounded(layer.y[i])}${layer.spread ? " ± " + rounded(layer.spread[i]) : ""}`);
      if (layer.values) lines.push(`${rounded(layer.values[i])} ${layer.unit || this.figure.unit || ""}`.trim());
      return [...lines, ...this.figure.details(layer.x.length, i)];
    }
    areaLines(layer, x, y) {
      if (layer.layer === "Bars") {
        const i = Math.round((layer.upright ? x : y) - layer.shift), names = this.names(layer.upright ? "x" : "y");
        if (i < 0 || i >= layer.values.length) return null;
        const spread = layer.spread ? ` ± ${rounded(layer.spread[i])}` : "";
        return [`${names && names[i] ? names[i] : i}: ${rounded(layer.values[i])}${spread}`];
      }
      if (layer.layer === "Histogram") {
        const i = layer.edges.findIndex(edge => edge > x) - 1;
        return i < 0 ? null : [`${rounded(layer.edges[i])} to ${rounded(layer.edges[i + 1])}`, `${layer.counts[i]} ${this.panel.y}`];
      }
      if (layer.layer === "Heat") {
        const [rows, columns] = layer.shape, [l, r, b, t] = extent(layer);
        const j = Math.floor((x - l) / (r - l) * columns), i = Math.floor((y - t) / (b - t) * rows);
        if (i < 0 || j < 0 || i >= rows || j >= columns) return null;
        const [xnames, ynames] = [this.names("x"), this.names("y")];
        return [`${ynames ? ynames[i] : i}, ${xnames ? xnames[j] : j}: ${rounded(layer.values[i * columns + j])} ${layer.unit}`.trim()];
      }
      if (layer.layer === "Box" && Math.abs(y - layer.position) < 0.4) {
        const [low, first, median, third, high] = layer.quantiles.map(rounded), names = this.names("y");
        return [names ? names[layer.position] : "", `median ${median}`, `quartiles ${first}, ${third}`, `5 %, 95 %: ${low}, ${high}`];
      }
      return null;
    }
  }
  const plainLabel = words => (words || "").split(";")[0];
  // 1, 2 and 5 times powers of ten; over two decades and more, powers of ten; where neither is in view, even steps
  function logTicks(low, high, most) {
    const factors = high < 100 * low ? [1, 2, 5] : [1], first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
    const stride = Math.max(1, Math.ceil((last - first + 1) / most)), ticks = [];
    for (let power = first; power <= last; power += stride) for (const factor of factors) {
      const value = +(factor * 10 ** power).toPrecision(6);
      if (value >= low && value <= high) ticks.push(value);
    }
    if (ticks.length > 1) return ticks;
    const step = 10 ** Math.floor(Math.log10((high - low) / 2)), even = [];
    for (let value = Math.ceil(low / step) * step; value <= high && even.length < 10; value += step) even.push(+value.toPrecision(6));
    return even;
  }
  function symlogTicks(low, high, linear) {
    const ticks = low <= 0 && high >= 0 ? [0] : [];
    for (let value = linear; value < 1e12; value *= 10) for (const one of [value, -value]) if (one >= low && one <= high) ticks.push(one);
    return ticks.sort((a, b) => a - b);
  }
  function bar(c, map, low, high, unit, x, top, bottom) {
    for (let k = 0; k < STEPS; k++) {
      c.fillStyle = shade(map, k / (STEPS - 1));
      c.fillRect(x, bottom - (bottom - top) * (k + 1) / STEPS, 8, (bottom - top) / STEPS + 0.5);
    }
    c.fillStyle = ink(INK); c.textAlign = "left";
    for (const share of [0, 0.5, 1]) {
      c.fillText(String(+(low + share * (high - low)).toPrecision(3)), x + 11, bottom - share * (bottom - top) + (share === 1 ? 9 : share ? 4 : 0));
    }
    if (unit) c.fillText(unit, x - 2, bottom + 14);
  }
  function linked(link) { return drawn.flatMap(figure => (figure.link === link ? figure.panels.filter(p => p.plot) : [])); }

  // what the pointer reads

  const tip = document.createElement("div");
  tip.className = "tip";
  tip.setAttribute("aria-hidden", "true");
  tip.hidden = true;
  document.body.append(tip);
  function showTip(over, left, top, lines) {
    const box = over.getBoundingClientRect();
    tip.replaceChildren(...lines.map(line => Object.assign(document.createElement("div"), { textContent: line })));
    tip.hidden = false;
    const x = box.left + left + 14, y = box.top + top + 14;
    tip.style.left = Math.max(4, Math.min(x, innerWidth - tip.offsetWidth - 6)) + "px";
    tip.style.top = (y + tip.offsetHeight > innerHeight ? y - tip.offsetHeight - 28 : y) + "px";
  }
  function hideTip() { tip.hidden = true; }
  addEventListener("scroll", hideTip, { passive: true });

  // a map that turns: points in space, seen from afar

  class Space {
    constructor(figure, cloud, box) {
      Object.assign(this, { figure, cloud, box, turn: -0.9, rise: 0.45, near: 1 });
      this.points = cloud.points.shape ? cloud.points : Float32Array.from(cloud.points.flatMap(p => [...p])); this.values = cloud.values;
      this.canvas = document.createElement("canvas");
      this.canvas.tabIndex = 0;
      this.canvas.className = "space";
      this.canvas.setAttribute("role", "img");
      this.canvas.setAttribute("aria-label", `${this.values.length} points in space, ${rounded(cloud.low)} to ${rounded(cloud.high)} ${cloud.unit}. Arrow keys turn the map, plus and minus zoom, 0 goes back.`);
      const views = document.createElement("p");
      views.className = "views";
      for (const [name, turn, rise] of [["in space", -0.9, 0.45], ["from above", -Math.PI / 2, Math.PI / 2], ["from the side", -Math.PI / 2, 0]]) {
        views.append(button(name, () => { Object.assign(this, { turn, rise, near: 1 }); this.paint(); }));
      }
      box.append(this.canvas, views);
      this.measure();
      this.listen();
    }
    measure() {
      const n = this.values.length, low = [0, 0, 0], high = [0, 0, 0]; // the base stands at the origin
      for (let i = 0; i < n; i++) for (let k = 0; k < 3; k++) {
        const v = this.points[3 * i + k];
        if (v < low[k]) low[k] = v; if (v > high[k]) high[k] = v;
      }
      this.low = low; this.high = high;
      this.middle = low.map((v, k) => (v + high[k]) / 2);
      this.reach = Math.hypot(...low.map((v, k) => high[k] - v)) / 2 || 1;
    }
    listen() {
      const canvas = this.canvas;
      canvas.addEventListener("pointerdown", event => {
        canvas.setPointerCapture(event.pointerId);
        let last = [event.clientX, event.clientY];
        const dragged = next => {
          this.turn -= (next.clientX - last[0]) / 120;
          this.rise = Math.min(Math.max(this.rise + (next.clientY - last[1]) / 120, -Math.PI / 2), Math.PI / 2);
          last = [next.clientX, next.clientY];
          hideTip(); this.paint();
        };
        canvas.addEventListener("pointermove", dragged);
        canvas.addEventListener("pointerup", () => canvas.removeEventListener("pointermove", dragged), { once: true });
      });
      canvas.addEventListener("mousemove", event => this.read(event));
      canvas.addEventListener("mouseleave", hideTip);
      canvas.addEventListener("dblclick", () => { Object.assign(this, { turn: -0.9, rise: 0.45, near: 1 }); this.paint(); });
      canvas.addEventListener("wheel", event => {
        if (!event.ctrlKey && !event.metaKey) return;
        event.preventDefault(); this.near *= event.deltaY > 0 ? 0.8 : 1.25; this.paint();
      }, { passive: false });
      canvas.addEventListener("keydown", event => {
        const keys = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] }[event.key];
        if (keys) { this.turn += keys[0]; this.rise = Math.min(Math.max(this.rise + keys[1], -Math.PI / 2), Math.PI / 2); }
        else if (event.key === "+" || event.key === "=") this.near *= 1.25;
        else if (event.key === "-") this.near *= 0.8;
        else if (event.key === "0") Object.assign(this, { turn: -0.9, rise: 0.45, near: 1 });
        else return;
        event.preventDefault(); this.paint();
      });
    }
    size(width) {
      const height = Math.min(0.62 * width, 460), ratio = Math.max(2, devicePixelRatio || 1);
      Object.assign(this, { width, height, ratio });
      Object.assign(this.canvas, { width: width * ratio, height: height * ratio });
      Object.assign(this.canvas.style, { width: width + "px", height: height + "px" });
      this.paint();
    }
    // (right, up, towards the eye) of a point, in pixels
    seen(p) {
      const q = p.map((v, k) => v - this.middle[k]), [ct, st] = [Math.cos(this.turn), Math.sin(this.turn)];
      const [cr, sr] = [Math.cos(this.rise), Math.sin(this.rise)], unit = this.near * 0.45 * Math.min(this.height, this.width) / this.reach;
      const right = -st * q[0] + ct * q[1], away = ct * q[0] + st * q[1];
      return [this.width / 2 + unit * right, this.height / 2 - unit * (cr * q[2] - sr * away), cr * away + sr * q[2]];
    }
    paint() {
      const c = this.canvas.getContext("2d"), { low, high } = this;
      c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
      c.clearRect(0, 0, this.width, this.height);
      c.font = FONT;
      this.frame(c, low, high);
      const places = [];
      for (let i = 0; i < this.values.length; i++) places.push([...this.seen([...this.points.slice(3 * i, 3 * i + 3)]), i]);
      places.sort((a, b) => a[2] - b[2]);
      this.places = places;
      const rows = this.figure.points.row;
      c.lineWidth = 0.5;
      for (const [x, y, , i] of places) {
        c.fillStyle = shade("cividis_r", (this.values[i] - this.cloud.low) / (this.cloud.high - this.cloud.low || 1));
        c.strokeStyle = ink(QUIET);
        c.beginPath(); c.arc(x, y, 4, 0, 6.3); c.fill(); c.stroke();
        if (rows && rows.length === this.values.length && isMarked(rows[i], this.figure.fileOf(i))) {
          c.strokeStyle = ink(MARK); c.lineWidth = 1.8; c.beginPath(); c.arc(x, y, 8, 0, 6.3); c.stroke(); c.lineWidth = 0.5;
        }
      }
      bar(c, "cividis_r", this.cloud.low, this.cloud.high, `[${this.cloud.unit}]`, this.width - 50, 20, this.height - 34);
    }
    // the box around the points, its axes from the corner of the least values, and the base
    frame(c, low, high) {
      const corner = bits => [0, 1, 2].map(k => (bits >> k & 1 ? high[k] : low[k]));
      c.strokeStyle = dark() ? "#3a3f46" : "#d9dce0"; c.lineWidth = 1;
      for (let a = 0; a < 8; a++) for (let k = 0; k < 3; k++) if (!(a >> k & 1)) {
        const [p, q] = [this.seen(corner(a)), this.seen(corner(a | 1 << k))];
        c.beginPath(); c.moveTo(p[0], p[1]); c.lineTo(q[0], q[1]); c.stroke();
      }
      c.fillStyle = ink(INK); c.textAlign = "center";
      for (let k = 0; k < 3; k++) {
        const [begin, end] = [this.seen(corner(0)), this.seen(corner(1 << k))];
        c.strokeStyle = ink(QUIET); c.beginPath(); c.moveTo(begin[0], begin[1]); c.lineTo(end[0], end[1]); c.stroke();
        c.fillText(`${"xyz"[k]} ${+high[k].toPrecision(2)} m`, end[0], end[1] + 14);
      }
      const base = this.seen([0, 0, 0]);
      c.strokeStyle = ink(INK); cross(c, base[0], base[1], 6); c.fillText("base", base[0], base[1] - 9);
    }
    read(event) {
      if (event.buttons || !this.places) return;
      const box = this.canvas.getBoundingClientRect(), [x, y] = [event.clientX - box.left, event.clientY - box.top];
      let best = null, distance = NEAR;
      for (const place of this.places) {
        const away = Math.hypot(place[0] - x, place[1] - y);
        if (away <= distance) { distance = away; best = place; }
      }
      if (!best) { hideTip(); return; }
      const i = best[3], at = [...this.points.slice(3 * i, 3 * i + 3)].map(v => v.toFixed(3)).join(", ");
      showTip(this.canvas, x, y, [`${rounded(this.values[i])} ${this.cloud.unit}`, `x, y, z: ${at} m`, ...this.figure.details(this.values.length, i)]);
    }
  }

  // a figure: its panels, legend and buttons

  function button(words, act) {
    const made = document.createElement("button");
    made.type = "button"; made.textContent = words;
    made.addEventListener("click", act);
    return made;
  }
  class Figure {
    constructor(element) {
      this.element = element;
      this.name = element.dataset.figure;
      this.chart = resolved(figures[this.name]);
      this.box = element.querySelector(".plot");
      this.link = this.chart.linked || (this.chart.shared.includes("x") && !this.chart.shared.includes("y") ? element.dataset.figure : "");
      this.points = this.chart.points || {};
      for (const panel of this.chart.panels) panel.layers.forEach(prepared);
      this.box.setAttribute("role", "group");
      this.box.replaceChildren();
      this.head();
      this.grid = document.createElement("div");
      this.grid.className = "panels";
      this.live = document.createElement("p");
      this.live.className = "spoken";
      this.live.setAttribute("aria-live", "polite");
      this.box.append(this.grid, this.live);
      if (this.chart.cloud) {
        const box = document.createElement("div");
        this.box.insertBefore(box, this.grid);
        this.space = new Space(this, this.chart.cloud, box);
      }
      this.panels = this.chart.panels.map((panel, k) => {
        const box = document.createElement("div");
        box.className = "panel";
        this.grid.append(box);
        return new Panel(this, panel, k, box);
      });
      this.layout();
    }
    head() {
      const head = document.createElement("div");
      head.className = "figure-head";
      const title = document.createElement("p");
      title.className = "figure-title";
      title.textContent = this.chart.title;
      head.append(title);
      const labels = new Map();
      for (const panel of this.chart.panels) for (const layer of panel.layers) {
        if (layer.label) labels.set(layer.label, [...(labels.get(layer.label) || []), layer]);
      }
      for (const [label, layers] of labels) head.append(this.entry(label, layers));
      head.append(this.buttons());
      this.box.append(head);
    }
    // of the legend: shows and hides layers
    entry(label, layers) {
      const made = button(label, () => {
        const off = made.getAttribute("aria-pressed") === "true";
        for (const layer of layers) layer.off = off;
        made.setAttribute("aria-pressed", String(!off));
        this.redraw();
      });
      made.className = "entry";
      made.setAttribute("aria-pressed", "true");
      const colour = layers[0].colour || layers[0].colours;
      if (typeof colour === "string") made.dataset.colour = colour;
      return made;
    }
    buttons() {
      const made = document.createElement("span");
      made.className = "zoom";
      const each = act => () => this.link ? act(this.visible()[0]) : this.visible().forEach(act);
      for (const [words, label, act] of [["+", "zoom in", p => p.zoom(0.6)], ["−", "zoom out", p => p.zoom(1 / 0.6)], ["‹", "to the left", p => p.shift(-0.3)], ["›", "to the right", p => p.shift(0.3)], ["⟲", "whole figure", p => this.back(p)]]) {
        const one = button(words, each(act));
        one.title = label; one.setAttribute("aria-label", label);
        made.append(one);
      }
      return made;
    }
    // all samples of thinned curves, from the file beside the page, once a part of them is looked at
    wholeFor(panel) {
      if (!this.chart.whole || this.asked) return;
      const [low, high] = panel.range_of("x");
      if (high - low > 0.7 * (panel.home[0][1] - panel.home[0][0])) return;
      this.asked = true;
      const script = document.createElement("script");
      script.src = this.chart.whole;
      script.addEventListener("error", () => this.note(`Peaks are kept, other samples are not: all of them are in ${this.chart.whole}, which is not beside this page or may not be read.`));
      document.head.append(script);
    }
    note(words) {
      this.said = this.said || this.element.appendChild(Object.assign(document.createElement("p"), { className: "note" }));
      this.said.textContent = words;
    }
    take(chart) {
      chart.panels.forEach((panel, k) => panel.layers.forEach((layer, i) => {
        if (layer.layer === "Line") Object.assign(this.chart.panels[k].layers[i], { x: layer.x, y: layer.y });
      }));
      this.note("All samples are loaded.");
      this.element.dataset.whole = "yes";
      this.redraw();
    }
    visible() { return this.panels.filter(panel => panel.plot && !panel.box.hidden); }
    back(panel) { for (const one of this.link ? linked(this.link) : [panel]) { one.quiet = true; one.back(); one.quiet = false; } }
    // the file of a point
    fileOf(i) { return (this.chart.files || [])[(this.points.file || [])[i]] || ""; }
    details(count, i) {
      return Object.entries(this.points).filter(([, values]) => values.length === count).map(([name, values]) => `${name} ${name === "file" ? this.fileOf(i) : rounded(values[i])}`);
    }
    layout() {
      const width = printing ? PRINT_WIDTH * (this.element.classList.contains("wide") ? 1 : 0.48) : this.box.clientWidth;
      if (!width) return;
      this.swatches();
      if (this.space) this.space.size(Math.floor(width));
      const off = panel => panel.panel.switch && hidden.has(panel.panel.switch);
      const panels = this.panels.filter(panel => { panel.box.hidden = !!off(panel); return !off(panel); });
      const least = this.chart.shared.includes("y") && this.chart.shared.includes("x") ? SMALL_WIDTH : WIDTH;
      const columns = Math.max(1, Math.min(this.chart.columns, panels.length || 1, Math.floor(width / (printing ? 0.65 * least : least))));
      Object.assign(this, { columns, shownPanels: panels });
      const each = Math.floor((width - 10 * (columns - 1)) / columns), rows = Math.ceil(this.chart.panels.length / this.chart.columns);
      const natural = (72 * this.chart.height * PT - 28) / rows * (printing ? 0.95 : 1.25);
      this.grid.style.gridTemplateColumns = `repeat(${columns}, ${each}px)`;
      for (const panel of panels) {
        const equal = panel.panel.equal || panel.layers.some(layer => layer.extent);
        panel.build(each, Math.round(Math.max(equal ? 0.8 * each : natural, 110)));
      }
    }
    // colours of the legend on the paper of the moment
    swatches() { for (const made of this.box.querySelectorAll("[data-colour]")) made.style.setProperty("--colour", ink(made.dataset.colour)); }
    redraw() { this.swatches(); if (this.space) this.space.paint(); for (const panel of this.visible()) panel.plot.redraw(false); }
  }

  // one row of switches for all figures of a part, such as its joints

  function switches(part) {
    const names = new Set();
    let first = null;
    for (const element of part.querySelectorAll("figure.chart")) {
      const chart = figures[element.dataset.figure];
      for (const panel of chart.panels) for (const name of [panel.switch, ...panel.layers.map(layer => layer.switch)]) if (name) { names.add(name); first = first || element; }
    }
    if (names.size < 2) return;
    const row = document.createElement("div");
    row.className = "switches";
    row.setAttribute("role", "group");
    row.setAttribute("aria-label", "shown joints; a double click shows one alone");
    const made = [...names].map(name => {
      const one = button(name, () => { if (!hidden.delete(name)) hidden.add(name); update(); });
      one.addEventListener("dblclick", () => { const alone = hidden.size === names.size - 1 && !hidden.has(name); hidden.clear(); if (!alone) for (const other of names) if (other !== name) hidden.add(other); update(); });
      one.dataset.switch = name;
      row.append(one);
      return one;
    });
    const all = button("all", () => { hidden.clear(); update(); });
    row.append(all);
    function update() {
      for (const one of made) one.setAttribute("aria-pressed", String(!hidden.has(one.dataset.switch)));
      for (const figure of drawn) if (part.contains(figure.element)) {
        const views = figure.link && figure.visible()[0] ? figure.visible()[0].range_of("x") : null;
        figure.layout();
        if (views) for (const panel of figure.visible()) { panel.quiet = true; panel.view(views, null); panel.quiet = false; }
      }
    }
    update();
    first.closest(".figures").before(row);
  }

  // tables that are sorted by the column whose head is chosen

  function sortable(table) {
    const body = table.tBodies[0];
    if (!body || body.rows.length < 3) return;
    const groups = [];
    for (const row of body.rows) {
      if (row.classList.contains("group") || !groups.length) groups.push({ head: row.classList.contains("group") ? row : null, rows: [] });
      if (!row.classList.contains("group")) groups[groups.length - 1].rows.push(row);
    }
    for (const group of groups) group.order = group.rows.slice();
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, k) => {
      head.tabIndex = 0; head.classList.add("sortable"); head.title = "sort";
      const sort = () => {
        const state = { none: "ascending", ascending: "descending", descending: "none" }[head.getAttribute("aria-sort") || "none"];
        for (const other of heads) other.removeAttribute("aria-sort");
        if (state !== "none") head.setAttribute("aria-sort", state);
        for (const group of groups) {
          const rows = state === "none" ? group.order : group.rows.slice().sort((a, b) => compared(a.cells[k], b.cells[k], state === "descending" ? -1 : 1));
          if (group.head) body.append(group.head);
          body.append(...rows);
        }
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", event => { if (event.key === "Enter" || event.key === " ") { event.preventDefault(); sort(); } });
    });
  }
  function compared(a, b, sign) {
    const [s, t] = [a, b].map(cell => (cell ? cell.textContent.trim().replace("−", "-") : ""));
    const [p, q] = [parseFloat(s), parseFloat(t)];
    if (Number.isNaN(p) && Number.isNaN(q)) return sign * s.localeCompare(t);
    if (Number.isNaN(p) || Number.isNaN(q)) return Number.isNaN(p) ? 1 : -1; // what is no number stands last
    return sign * (p - q);
  }

  // links from the rows that a finding names to their points

  const ROWS = /\brows? \d+(?:(?:, | and |–)\d+)*/g;
  function rowLinks(item) {
    const target = Object.entries(figures).find(([, chart]) => chart.panels.some(panel => panel.x === "row"));
    if (!target || item.closest("nav")) return;
    const files = target[1].panels.map(panel => panel.file).filter(Boolean);
    const walker = document.createTreeWalker(item, NodeFilter.SHOW_TEXT), texts = [];
    while (walker.nextNode()) texts.push(walker.currentNode);
    for (const node of texts) {
      const parts = [];
      let last = 0;
      for (const match of node.data.matchAll(ROWS)) {
        const link = document.createElement("a");
        link.href = "#figure-" + target[0]; link.className = "rows"; link.textContent = match[0];
        link.dataset.rows = [...rowsOf(match[0])].join(",");
        link.dataset.file = fileIn(item.textContent, files, item.textContent.indexOf(match[0]));
        link.addEventListener("click", () => {
          marked.rows = new Set(link.dataset.rows.split(",").map(Number));
          marked.file = link.dataset.file;
          draw(document.getElementById("figure-" + target[0]));
          for (const figure of drawn) figure.redraw();
          const rows = drawn.find(one => one.name === target[0]);
          const present = rows.panels.some(one => one.layers.some(layer => layer.x && layer.x.some(row => isMarked(row, one.panel.file))));
          rows.note(present ? "" : `None of ${match[0]} is among the points drawn; residuals.csv has every row.`);
        });
        parts.push(node.data.slice(last, match.index), link);
        last = match.index + match[0].length;
      }
      if (parts.length) node.replaceWith(...parts, node.data.slice(last));
    }
  }

  // the file that a sentence names last before a place, else first behind it; empty: none
  function fileIn(sentence, files, place) {
    const found = [];
    for (const file of new Set(files)) {
      for (let at = sentence.indexOf(file); at >= 0; at = sentence.indexOf(file, at + 1)) {
        if (!/[\w.-]/.test(sentence[at - 1] || " ") && !/[\w-]/.test(sentence[at + file.length] || " ")) found.push([at, file]);
      }
    }
    found.sort((a, b) => a[0] - b[0]);
    const before = found.filter(([at]) => at < place);
    return ((before.length ? before[before.length - 1] : found[0]) || [0, ""])[1];
  }

  // called by a file of samples
  window.calibFigure = (name, chart) => {
    const figure = drawn.find(one => one.name === name);
    if (figure) figure.take(resolved(chart));
  };

  function* rowsOf(words) {
    for (const part of words.match(/\d+(?:–\d+)?/g)) {
      const [first, last] = part.split("–").map(Number);
      for (let row = first; row <= (last || first) && row < first + 1e6; row++) yield row;
    }
  }

  // start: figures are drawn when they come near the view, and all of them for print

  const elements = [...document.querySelectorAll("figure.chart")];
  function draw(element) {
    if (element.dataset.drawn) return;
    element.dataset.drawn = "yes";
    drawn.push(new Figure(element));
  }
  const watcher = new IntersectionObserver(entries => {
    for (const entry of entries) if (entry.isIntersecting) { watcher.unobserve(entry.target); draw(entry.target); }
  }, { rootMargin: "800px" });
  elements.forEach(element => watcher.observe(element));
  document.querySelectorAll("section.part, main > section").forEach(switches);
  document.querySelectorAll("table").forEach(sortable);
  document.querySelectorAll("li").forEach(rowLinks);
  let width = innerWidth;
  addEventListener("resize", () => { if (innerWidth !== width && !printing) { width = innerWidth; drawn.forEach(figure => figure.layout()); } });
  darkness.addEventListener("change", () => drawn.forEach(figure => figure.redraw()));
  addEventListener("beforeprint", () => { printing = true; elements.forEach(draw); drawn.forEach(figure => figure.layout()); });
  addEventListener("afterprint", () => { printing = false; drawn.forEach(figure => figure.layout()); });
})();
