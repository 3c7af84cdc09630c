// A circuit element over SOC: functions (2.5)-(2.9) of Chen and Mora, and learned values with errors.
import { OverSoc, nulls, scaled } from "./charts.js";
import { $, attribute, changed, hide, node, text } from "./dom.js";
import * as f from "./format.js";
import { ELEMENTS } from "./parameters.js";

// number of the first of three coefficients a1..a15, sign of its term
const FORM = { r_ts_ohm: [1, 1], r_tl_ohm: [4, 1], c_ts_farad: [7, -1], c_tl_farad: [10, -1], r_s_ohm: [13, 1] };
const GRID = Array.from({ length: 101 }, (_, i) => i);
let overSoc = null;

export function drawElement(pack) {
	const report = pack.topics.parameters, names = Object.keys(report?.elements ?? {}).filter((n) => n in FORM || (n === "e_o_v" && report.ocv));
	hide($("elementcard"), !names.length);
	if (!names.length) return;
	if (changed($("element"), names.join())) {
		const before = $("element").value;
		$("element").replaceChildren(...names.map((n) => node("option", { value: n }, `${ELEMENTS[n][0]} [${ELEMENTS[n][2]}]`)));
		$("element").value = names.includes(before) ? before : names[0];
	}
	const name = $("element").value, [label, factor] = ELEMENTS[name], p = report.elements[name], { soc, ocv } = report;
	overSoc ??= new OverSoc($("elementchart"), 236);
	const now = f.isNumber(soc) && f.isNumber(p.value) ? { soc: 100 * soc, value: factor * p.value, std: factor * (p.std ?? 0) } : null;
	if (name === "e_o_v") {
		const edge = (sign) => ocv.ocv_v.map((v, i) => v + sign * 2 * ocv.std_v[i]);
		overSoc.draw([scaled(ocv.soc, 100), edge(1), edge(-1), ocv.ocv_v, nulls(ocv.soc)], now);
		text($("elementnote"), "Open-circuit voltage at 25 °C, ± 2 std.");
		return;
	}
	const at = GRID.map((i) => pack.learned[name]?.[i]), seen = at.filter(Boolean).length;
	const edge = (sign) => at.map((l) => (l ? factor * Math.max(l[0] + sign * 2 * l[1], 0) : null));
	overSoc.draw([GRID, edge(1), edge(-1), edge(0), curveOf(report.a, name, factor)], now);
	text($("elementnote"), `Dashed: ${label} as a₁…a₁₅ have it. ${seen ? `Band: learned, ± 2 std, where the pack has been since this page is served.` : "Not known well enough yet for a band."}`);
}

/** a e^(-b soc) + c, with -a for a capacitance; null where it is not positive. */
function curveOf(a, name, factor) {
	const [first, sign] = FORM[name], [p, q, r] = [0, 1, 2].map((i) => a?.[`a${first + i}`]?.value);
	const value = (soc) => sign * p * Math.exp(-q * soc) + r;
	return GRID.map((i) => (value(i / 100) > 0 ? factor * value(i / 100) : null));
}

/** Describe the chart in words. */
export function describeElement(pack) {
	const p = pack.topics.parameters?.elements?.[$("element").value], [name, factor, unit] = ELEMENTS[$("element").value] ?? [];
	if (!p || !name) return;
	const [value, std] = f.withError(p.value, p.std, factor);
	attribute($("elementchart"), "aria-label", `${name} over state of charge, now ${value} ${unit}${std && `, standard deviation ${std} ${unit}`}`);
}

export const redrawElement = () => overSoc?.plot.redraw(false, true);
