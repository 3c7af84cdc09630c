// Cells in series: their voltages, and their comparison.
import { $, attribute, changed, hide, node, put, text } from "./dom.js";
import * as f from "./format.js";

export function drawCells(s) {
	const cells = Array.isArray(s.cells_v) ? s.cells_v : [], known = cells.filter(f.isNumber), count = known.length;
	hide($("cellcard"), !count);
	attribute($("pack"), "class", count ? "withcells" : "");
	if (!count) return;
	const low = Math.min(...known), high = Math.max(...known), mean = known.reduce((a, b) => a + b) / count;
	const first = cells.indexOf(low), last = cells.indexOf(high);
	const reach = Math.max(high - low, 0.04), floor = Math.max(low - reach, 0), roof = high + 0.25 * reach, bars = $("cells");
	while (bars.childElementCount > cells.length) bars.lastChild.remove();
	while (bars.childElementCount < cells.length) {
		bars.append(node("li", { role: "img" }, node("b", {}), node("div", { class: "cellbar" }, node("i", {})), node("small", {}), node("span", {}, String(bars.childElementCount + 1))));
	}
	attribute(bars, "class", count > 16 ? "many" : "");
	cells.forEach((v, i) => {
		const item = bars.children[i], [value, box, apart] = item.children, measured = f.isNumber(v);
		const rank = low === high ? "" : i === first ? "lowest" : i === last ? "highest" : "";
		text(value, f.fixed(v, 3));
		text(apart, measured ? f.fixed(1e3 * (v - mean), 0) : "");
		const scale = measured ? ((v - floor) / (roof - floor)).toFixed(3) : "0";
		if (changed(item, scale)) box.firstChild.style.transform = `scaleY(${scale})`;
		attribute(item, "class", rank);
		attribute(item, "aria-label", `cell ${i + 1}: ${measured ? `${v.toFixed(3)} V` : "not measured"}${rank && `, ${rank}`}`);
	});
	put("cellspread", `${count} measured · deviations in mV`);
	put("celllow", `${low.toFixed(3)} V · cell ${first + 1}`);
	put("cellhigh", `${high.toFixed(3)} V · cell ${last + 1}`);
	put("cellmean", `${mean.toFixed(3)} V`);
	put("cellapart", f.millivolts(high - low));
	put("celldev", f.millivolts(Math.sqrt(known.reduce((a, b) => a + (b - mean) ** 2, 0) / count)));
}

/** Draw the cells, the one with the lowest SOC first. */
export function drawRanks(report) {
	const cells = Array.isArray(report?.cells) ? report.cells.filter((c) => f.isNumber(c?.soc)) : [];
	hide($("cellranks"), !cells.length);
	if (!cells.length || !changed($("cellranks"), report)) return;
	const ranked = cells.sort((a, b) => a.soc - b.soc), [weakest] = ranked;
	put("weakestcell", `cell ${weakest.number}, SOC ${f.percent(weakest.soc)} ± ${f.percent(2 * weakest.soc_std)} %`);
	$("cellranks").querySelector("tbody").replaceChildren(...ranked.map((c) => node("tr", { "data-cell": c.number },
		node("th", { scope: "row" }, String(c.number)),
		...[f.percent(c.soc), f.percent(c.soc_std), f.percent(c.resistance_ratio, 0), f.percent(c.capacity_ratio, 0), f.digits(1e3 * c.self_discharge_a, 2)].map((x) => node("td", {}, x)),
		node("td", { class: c.fault ? "bad" : "" }, c.fault ?? ""))));
}
