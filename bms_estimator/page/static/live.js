// What pages share: the stream of what is new; elements touched only where they change.
const SILENT_MS = 16_000; // it speaks each 5 s

/** Hear /events for ever: `heard` gets each message, `turned` as `stream.open` may change. */
export function listen(heard, turned, stream = { open: false }) {
	const source = new EventSource("/events");
	let last = Date.now();
	const turn = (open) => { stream.open = open; turned(); };
	source.onmessage = (event) => {
		last = Date.now();
		heard(JSON.parse(event.data));
		turn(true);
	};
	source.onerror = () => turn(false);
	const watch = setInterval(() => { // refused, or a line that swallows all
		if (source.readyState !== EventSource.CLOSED && Date.now() - last < SILENT_MS) return;
		clearInterval(watch);
		source.close();
		turn(false);
		listen(heard, turned, stream);
	}, 1000);
	return stream;
}

export const changed = (element, key) => element.key !== key && ((element.key = key), true);
export const text = (element, value) => { if (changed(element, value)) element.textContent = value; };
export const attribute = (element, name, value) => { if (element.getAttribute(name) !== value) element.setAttribute(name, value); };
export const hide = (element, hidden) => { if (element.hidden !== hidden) element.hidden = hidden; };

export function node(name, attributes, ...children) {
	const element = document.createElement(name);
	for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
	element.append(...children);
	return element;
}
