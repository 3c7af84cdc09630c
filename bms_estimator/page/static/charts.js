// Charts with uPlot. Colors come from the style sheet, light or dark.
import { node } from "./dom.js";
import { clock, dayMonth, hourMinute, when } from "./format.js";

/* global uPlot */
const style = getComputedStyle(document.documentElement);
const color = (name) => () => style.getPropertyValue(name).trim();
const faint = (name) => color(`${name}-faint`);

/** The newest `size` rows, sorted by the first column. Columns are contiguous, so views need no copy. */
export class Ring {
	constructor(columns, size) {
		this.size = size;
		this.columns = Array.from({ length: columns }, () => new Float64Array(2 * size));
		this.clear();
	}
	clear() { this.start = this.end = 0; }
	get last() { return this.end > this.start ? this.columns[0][this.end - 1] : -Infinity; }
	push(row) {
		if (!(row[0] > this.last)) return; // late, after an outage
		if (this.end === 2 * this.size) { // full: move the rows to the start
			for (const column of this.columns) column.copyWithin(0, this.start, this.end);
			this.end -= this.start;
			this.start = 0;
		}
		this.columns.forEach((column, i) => { column[this.end] = row[i] ?? NaN; });
		this.end += 1;
		this.start = Math.max(this.start, this.end - this.size);
	}
	/** Views of all columns from `since` on. */
	views(since) {
		let from = this.start;
		while (from < this.end && this.columns[0][from] < since) from += 1;
		return this.columns.map((column) => column.subarray(from, this.end));
	}
}

export const clip = (x) => Math.min(Math.max(x, 0), 1);
/** Multiply by a factor. A missing value becomes null, uPlot's gap. */
export const scaled = (values, factor) => Array.from(values, (x) => (x !== null && Number.isFinite(x) ? factor * x : null));
export const nullGaps = (values) => scaled(values, 1);
export const nulls = (time) => new Array(time.length).fill(null);

const DAY_S = 86400, STEPS_S = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 3600, 7200, 14400, 21600, DAY_S, 2 * DAY_S, 5 * DAY_S, 10 * DAY_S];
function timeLabels(plot, splits) {
	const span = plot.scales.x.max - plot.scales.x.min;
	const text = span > 2 * DAY_S || splits[1] - splits[0] >= DAY_S ? dayMonth : span > 600 ? hourMinute : clock;
	return splits.map((s) => text(new Date(1e3 * s)));
}

const axis = { stroke: color("--dim"), grid: { stroke: color("--line"), width: 1 }, ticks: { show: false }, font: "11px system-ui, sans-serif" };
const thin = { points: { show: false }, pxAlign: 0 };
const minus = (text) => text.replace("-", "−");

/** Range of the data and a margin, at least `minSpan`, so that noise does not fill it. */
function rangeOver(minSpan, low = -Infinity, high = Infinity) {
	return (_, min, max) => {
		if (!Number.isFinite(min)) return [0, 1];
		const middle = (min + max) / 2, half = Math.max((max - min) * 0.56, minSpan / 2);
		return [Math.max(middle - half, low), Math.min(middle + half, high)];
	};
}

/** Axis labels with as many decimals as distinguish them. */
function axisLabels(_, splits) {
	const step = Math.abs(splits[1] - splits[0]) || 1;
	const decimals = [0, 1, 2, 3].find((d) => Math.abs(step * 10 ** d - Math.round(step * 10 ** d)) < 1e-6) ?? 4;
	return splits.map((v) => minus(v.toFixed(decimals)));
}

/** Chart as wide as its box. */
class Sized {
	draw(data) {
		const width = this.box.clientWidth;
		if (width && width !== this.plot.width) this.plot.setSize({ width, height: this.plot.height });
		this.plot.setData(data, false);
	}
}

/** Chart over time. Data: times, edges of the band, value, and optionally a second value. Charts with equal `sync` share the cursor. */
export class Curve extends Sized {
	constructor(parent, title, unit, name, minSpan, { low, high, first = "measured", second, sync = "time" } = {}) {
		super();
		Object.assign(this, { title, unit });
		this.box = node("figure", { class: "curve" });
		this.box.innerHTML = "<figcaption><b></b><span></span><output aria-hidden=true></output></figcaption><div role=img></div>";
		const [caption, body] = this.box.children;
		caption.children[0].textContent = title;
		caption.children[1].textContent = unit;
		if (second) {
			for (const [line, label] of [[name, first], [second.color, second.label]]) {
				caption.insertBefore(node("i", { class: line.slice(2) }, label), caption.lastChild);
			}
		}
		this.readout = caption.lastChild;
		this.body = body;
		parent.append(this.box);
		const edge = { ...thin, width: 0 };
		this.plot = new uPlot({
			width: 300, height: 132, legend: { show: false }, padding: [8, 26, 0, 0],
			series: [{}, edge, edge, { ...thin, stroke: color(name), width: 1.6 }, ...(second ? [{ ...thin, stroke: color(second.color), width: 1.6, dash: second.dash }] : [])],
			bands: [{ series: [1, 2], fill: faint(name) }],
			cursor: { drag: { x: false, y: false }, points: { show: false }, sync: { key: sync } },
			hooks: { setCursor: [(u) => this.showValues(u.cursor.idx)] },
			scales: { x: { time: false }, y: { range: rangeOver(minSpan, low, high) } },
			axes: [{ ...axis, values: timeLabels, size: 24, space: 90, incrs: STEPS_S }, { ...axis, size: 52, space: 26, values: axisLabels }],
		}, [[], [], [], [], ...(second ? [[]] : [])], body);
	}
	showValues(index) {
		const [time, , , ...values] = this.plot.data, at = index == null ? null : time[index];
		const shown = values.map((v) => v[index]).filter((v) => v != null).map((v) => `${minus(v.toFixed(3))} ${this.unit}`);
		this.readout.textContent = at == null ? "" : `${(this.span > DAY_S / 2 ? when : clock)(new Date(1e3 * at))}  ${shown.join("  ")}`;
	}
	draw(data, from, to) {
		this.span = to - from;
		this.plot.batch(() => {
			super.draw(data);
			this.plot.setScale("x", { min: from, max: to });
		});
	}
	/** Describe the chart for screen readers. */
	describe(span) {
		const values = Array.from(this.plot.data[3]).filter((v) => v != null), fixed = (v) => v.toFixed(3);
		const text = values.length ? `from ${fixed(Math.min(...values))} to ${fixed(Math.max(...values))} ${this.unit}, last ${fixed(values.at(-1))} ${this.unit}` : "nothing yet";
		this.body.setAttribute("aria-label", `${this.title}, ${span}: ${text}`);
	}
}

/** Chart over the SOC [%]: band, learned values, a formula, and the present value with its error bar. */
export class OverSoc extends Sized {
	constructor(box, height) {
		super();
		this.box = box;
		box.setAttribute("role", "img");
		const range = (_, min, max) => {
			const margin = 0.06 * (max - min || 1e-3 * Math.abs(min) || 1);
			return Number.isFinite(min) ? [min - margin, max + margin] : [0, 1];
		};
		this.plot = new uPlot({
			width: 300, height, legend: { show: false }, padding: [8, 20, 0, 0], cursor: { show: false },
			series: [{}, { ...thin, width: 0 }, { ...thin, width: 0 }, { ...thin, stroke: color("--volt"), width: 2 }, { ...thin, stroke: color("--dim"), width: 1.4, dash: [5, 4] }],
			bands: [{ series: [1, 2], fill: faint("--volt") }],
			hooks: { draw: [(u) => this.now && this.drawError(u, this.now)] },
			scales: { x: { time: false, range: [0, 100] }, y: { range } },
			axes: [{ ...axis, size: 24, values: (_, s) => s.map((v) => `${v} %`) }, { ...axis, size: 56, space: 34, values: axisLabels }],
		}, [[], [], [], [], []], box);
	}
	drawError(u, { soc, value, std }) {
		const c = u.ctx, r = devicePixelRatio, x = u.valToPos(soc, "x", true);
		const y = (v) => u.valToPos(Math.min(Math.max(v, u.scales.y.min), u.scales.y.max), "y", true);
		c.save();
		c.strokeStyle = c.fillStyle = color("--soc")();
		c.lineWidth = 2 * r;
		c.setLineDash([]);
		c.beginPath();
		c.moveTo(x, y(value + 2 * std));
		c.lineTo(x, y(value - 2 * std));
		for (const end of std ? [y(value + 2 * std), y(value - 2 * std)] : []) { c.moveTo(x - 5 * r, end); c.lineTo(x + 5 * r, end); }
		c.stroke();
		c.beginPath();
		c.arc(x, y(value), 4.5 * r, 0, 7);
		c.fill();
		c.restore();
	}
	draw(data, now) {
		this.now = now;
		super.draw(data);
		this.plot.setScale("x", { min: 0, max: 100 });
	}
}
