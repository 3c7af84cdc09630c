// Shows that a step runs, and the first estimates as they arrive.
for (const form of document.forms) form.addEventListener("submit", () => { for (const button of form.querySelectorAll("button")) button.disabled = true; });

const wait = document.getElementById("wait");
if (wait) {
	new EventSource("events").onmessage = (event) => {
		const { estimate } = JSON.parse(event.data);
		if (!estimate) return;
		const { unknown, ...values } = estimate;
		wait.hidden = true;
		document.getElementById("known").hidden = unknown;
		document.getElementById("unknown").hidden = !unknown;
		for (const [name, value] of Object.entries(values))
			document.querySelector(`[data-q="${name}"]`).textContent = value === null ? "–" : value.toFixed(name === "soc" || name === "band" ? 1 : 2);
	};
}
