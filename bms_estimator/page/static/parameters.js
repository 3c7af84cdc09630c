// Table of the parameters.
import { $, attribute, changed, node, text } from "./dom.js";
import * as f from "./format.js";

/** Symbol, factor and unit of each circuit element. */
export const ELEMENTS = {
	r_s_ohm: ["Rₛ", 1e3, "mΩ"], r_ts_ohm: ["Rₜₛ", 1e3, "mΩ"], c_ts_farad: ["Cₜₛ", 1, "F"], r_tl_ohm: ["Rₜₗ", 1e3, "mΩ"],
	c_tl_farad: ["Cₜₗ", 1, "F"], e_o_v: ["E₀", 1, "V"],
};
const HEALTH = { capacity: ["Capacity, of new", 100, "%"], r_s: ["Rₛ, of new", 100, "%"], current_offset_a: ["Current offset", 1e3, "mA"] };
const rows = new Map();

export function drawParameters(report) {
	if (!report || !changed(rows, report)) return;
	const all = Object.entries({ elements: ELEMENTS, state_of_health: HEALTH, a: {} }).flatMap(([group, names]) =>
		Object.entries(report[group] ?? {}).map(([key, p]) => [`${group} ${key}`, names[key] ?? [f.words(key), 1, "SI"], p]));
	const kept = new Set(all.map(([key]) => key));
	for (const [key, row] of rows) if (!kept.has(key)) { row.remove(); rows.delete(key); }
	for (const [key, [name, factor, unit], p] of all) {
		if (!rows.has(key)) {
			rows.set(key, node("tr", { "data-p": key }, node("th", { scope: "row" }, name), ...Array.from({ length: 5 }, () => node("td", {}))));
			$("params").append(rows.get(key));
		}
		const known = p.valid || !f.isNumber(p.std) || p.std < Math.abs(p.value);
		const texts = [...(known ? f.withError(p.value, p.std, factor) : ["not known yet", ""]), unit, p.valid ? "✓ yes" : "no",
			p.valid ? p.source + (p.updated ? `, ${f.clock(new Date(p.updated))}` : "") : p.reason ?? ""];
		const cells = [...rows.get(key).children].slice(1);
		cells.forEach((cell, i) => text(cell, texts[i]));
		attribute(cells[3], "class", p.valid ? "good" : "");
	}
}
