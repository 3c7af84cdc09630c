// Cells in series: their voltages, and their comparison.
import { $, attribute, changed, hide, node, put, text } from "./dom.js";
import * as f from "./format.js";

export function drawCells(s) {
	const cells = Array.isArray(s.cells_v) ? s.cells_v : [], known = cells.filter(f.isNumber), count = known.length;
	hide($("cellcard"), !count);
	if (!count) return;
	const low = Math.min(...known), high = Math.max(...known);
	const first = cells.indexOf(low), last = cells.indexOf(high);
	const reach = Math.max(high - low, 0.04), floor = Math.max(low - reach, 0), roof = high + 0.25 * reach, bars = $("cells");
	while (bars.childElementCount > cells.length) bars.lastChild.remove();
	while (bars.childElementCount < cells.length) {
		bars.append(node("li", { role: "img" }, node("b", {}), node("div", { class: "cellbar" }, node("i", {})), node("span", {}, String(bars.childElementCount + 1))));
	}
	attribute(bars, "class", count > 16 ? "many" : "");
	cells.forEach((v, i) => {
		const item = bars.children[i], [value, box] = item.children, measured = f.isNumber(v);
		const rank = low === high ? "" : i === first ? "lowest" : i === last ? "highest" : "";
		text(value, f.fixed(v, 3));
		const scale = measured ? ((v - floor) / (roof - floor)).toFixed(3) : "0";
		if (changed(item, scale)) box.firstChild.style.transform = `scaleY(${scale})`;
		attribute(item, "class", rank);
		attribute(item, "aria-label", `cell ${i + 1}: ${measured ? `${v.toFixed(3)} V` : "not measured"}${rank && `, ${rank}`}`);
	});
	put("cellspread", `${count} measured`);
	put("celllow", `${low.toFixed(3)} V · cell ${first + 1}`);
	put("cellhigh", `${high.toFixed(3)} V · cell ${last + 1}`);
	put("cellapart", f.millivolts(high - low));
}

/** Name the cell with the lowest SOC, its capacity once that of the pack is learned, and faulty cells. */
export function drawRanks(report, capacity) {
	const cells = Array.isArray(report?.cells) ? report.cells.filter((c) => f.isNumber(c?.soc)) : [];
	hide(document.querySelector("[data-of=weakestcell]"), !cells.length);
	if (!cells.length) return;
	const weakest = cells.reduce((a, b) => (b.soc < a.soc ? b : a)), faults = cells.filter((c) => c.fault).map((c) => `cell ${c.number}: ${c.fault}`);
	put("weakestcell", [`cell ${weakest.number}, SOC ${f.percent(weakest.soc)} ± ${f.percent(2 * weakest.soc_std)} %${capacity?.valid ? `, capacity ${f.percent(weakest.capacity_ratio, 0)} % of the others` : ""}`, ...faults].join("; "));
}
