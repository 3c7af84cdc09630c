// Elements of a page: find, make, and update what has changed.
const fields = {}; // elements that show one value, by the name of the value
for (const element of document.querySelectorAll("[data-q]")) fields[element.dataset.q] = element;

export const $ = (id) => document.getElementById(id);
export const changed = (element, key) => element.key !== key && ((element.key = key), true);
export const text = (element, value) => { if (changed(element, value)) element.textContent = value; };
export const attribute = (element, name, value) => { if (element.getAttribute(name) !== value) element.setAttribute(name, value); };
export const hide = (element, hidden) => { if (element.hidden !== hidden) element.hidden = hidden; };
export const put = (name, value) => text(fields[name], value);

export function node(name, attributes, ...children) {
	const element = document.createElement(name);
	for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
	element.append(...children);
	return element;
}
