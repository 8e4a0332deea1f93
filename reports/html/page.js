"use strict";
// Connects the rows of this page with DataTables, the filters and the panel. All texts of the run reach the page
// as text nodes or escaped.
(() => {
  const payload = JSON.parse(document.getElementById("payload").textContent);
  const byId = (id) => document.getElementById(id);
  const FIRST_FACT = 3; // a row: name, codes, sentences, then the facts
  const factIndex = new Map(payload.facts.map((fact, i) => [fact.name, FIRST_FACT + i]));
  const escape = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
  const digits = { px: 3, number: 2 };

  function shown(value, kind) {
    if (value === null || value === undefined) return "-";
    if (kind === "p") return value >= 1e-3 || value === 0 ? String(+value.toPrecision(2)) : value.toExponential(0);
    if (kind in digits) return Math.abs(value) < 1000 ? value.toFixed(digits[kind]) : value.toPrecision(3);
    return String(value);
  }

  function cell(kind, i) {
    return (value, type, row, meta) => {
      if (type !== "display") return kind === "codes" ? value.join(" ") : (value ?? (type === "filter" ? "" : null));
      if (kind === "name") return `<button type="button" class="open" data-row="${row[row.length - 1]}"><bdi>${escape(value) || "(no name)"}</bdi></button>`;
      if (kind === "verdict") return `<span class="badge ${escape(value)}">${escape(value)}</span>`;
      if (kind === "codes") return escape(value.join(", ").replaceAll("_", " "));
      if (kind === "text") return `<bdi>${escape(shown(value, kind))}</bdi>`;
      return escape(shown(value, kind));
    };
  }

  payload.rows.forEach((row, i) => row.push(i));
  const numeric = new Set(["count", "px", "number", "p"]);
  const source = (column) => (column.name === "image_name" ? 0 : column.name === "codes" ? 1 : factIndex.get(column.name));
  const columns = payload.columns.map((column) => ({
    data: source(column),
    title: column.title,
    name: column.name,
    render: cell(column.kind),
    type: numeric.has(column.kind) ? "num" : "string",
    orderSequence: numeric.has(column.kind) ? ["desc", "asc"] : ["asc", "desc"],
    className: numeric.has(column.kind) ? "dt-type-numeric" : column.kind,
  }));
  const table = new DataTable("#images", {
    data: payload.rows,
    columns,
    order: [],
    autoWidth: false,
    deferRender: true,
    pageLength: 25,
    layout: { topStart: "info", topEnd: "pageLength", bottomStart: null, bottomEnd: "paging" },
  });

  const scroller = byId("images").closest(".dt-layout-table");
  for (const [name, value] of [["role", "region"], ["tabindex", "0"], ["aria-label", "Table of images"]]) scroller.setAttribute(name, value);

  function fill(select, values) {
    for (const value of values) select.add(new Option(select.id === "filter-reason" ? value.replaceAll("_", " ") : value, value));
    select.parentElement.hidden = values.length < 2;
  }
  const sorted = (values) => [...new Set(values)].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
  const values = (name) => payload.rows.map((row) => row[factIndex.get(name)] ?? "");
  fill(byId("filter-verdict"), sorted(values("verdict")));
  fill(byId("filter-scene"), sorted(values("scene")));
  fill(byId("filter-reason"), sorted(payload.rows.flatMap((row) => row[1])));

  function filter() {
    const text = byId("filter-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    const verdict = byId("filter-verdict").value, scene = byId("filter-scene").value, reason = byId("filter-reason").value;
    const at = (row, name) => row[factIndex.get(name)];
    table.search.fixed("filters", (_, row) =>
      (!verdict || at(row, "verdict") === verdict) && (!scene || at(row, "scene") === scene) &&
      (!reason || row[1].includes(reason)) &&
      text.every((word) => `${row[0]} ${at(row, "scene")} ${row[1].join(" ")}`.toLowerCase().includes(word)));
    table.draw();
  }
  const form = byId("filters");
  let waiting;
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(filter, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); filter(); });
  form.addEventListener("reset", () => setTimeout(filter));

  const dialog = byId("panel");
  const text = (tag, content) => Object.assign(document.createElement(tag), { textContent: content });
  function open(index) {
    const row = payload.rows[index];
    byId("panel-title").textContent = row[0] || "(no name)";
    const verdict = row[factIndex.get("verdict")];
    byId("panel-verdict").replaceChildren(Object.assign(text("span", verdict), { className: `badge ${verdict}` }));
    byId("panel-reasons").replaceChildren(...row[2].map((sentence) => text("li", sentence)));
    const pictures = byId("panel-pictures");
    pictures.hidden = index >= payload.numPictures;
    pictures.firstElementChild.href = `#worst-${index}`;
    byId("panel-facts").replaceChildren(...payload.facts.map((fact, i) => {
      const line = document.createElement("tr");
      const value = row[FIRST_FACT + i];
      const unit = fact.unit === "px" && value !== null ? " px" : "";
      const name = Object.assign(text("th", fact.name), { scope: "row" });
      line.append(name, text("td", value === null ? "-" : String(value) + unit), text("td", fact.meaning));
      return line;
    }));
    dialog.showModal();
    dialog.scrollTop = 0;
  }
  byId("images").addEventListener("click", (event) => {
    const button = event.target.closest("button.open");
    if (button) open(Number(button.dataset.row));
  });
  byId("panel-pictures").addEventListener("click", (event) => {
    const target = document.querySelector(event.target.getAttribute("href"));
    dialog.close();
    if (target) { target.open = true; target.querySelector("summary").focus(); target.scrollIntoView(); }
    event.preventDefault();
  });
  dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
  document.documentElement.dataset.ready = "true";
})();
