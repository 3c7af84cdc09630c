// Shared by the pages: the event stream, and updates of elements that have changed.
const SILENT_MS = 16_000; // an event arrives each 5 s

/** Receive /events for ever. `onState` is called when `stream.open` may have changed. */
export function listen(onMessage, onState, stream = { open: false }) {
	const source = new EventSource("/events");
	let last = Date.now();
	const setOpen = (open) => { stream.open = open; onState(); };
	source.onmessage = (event) => {
		last = Date.now();
		onMessage(JSON.parse(event.data));
		setOpen(true);
	};
	source.onerror = () => setOpen(false);
	const watch = setInterval(() => { // refused, or nothing arrives any more
		if (source.readyState !== EventSource.CLOSED && Date.now() - last < SILENT_MS) return;
		clearInterval(watch);
		source.close();
		setOpen(false);
		listen(onMessage, onState, stream);
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
