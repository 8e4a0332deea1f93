"use strict";
// The table of a page, its filters, and the links that ask one thing of it. What the pages of `report` and `diff` share.
// All texts of a run reach the page as text nodes or escaped.
const escapeText = (text) => String(text).replace(/[&<>"']/g, (c) => `&#${c.charCodeAt(0)};`);
const inPx = (value) => (Math.abs(value) < 1000 ? value.toFixed(3) : value.toPrecision(3));
const VERDICTS = new Set(["accepted", "rejected", "undetermined"]);
const verdictBadge = (value) => (VERDICTS.has(value) ? `<span class="badge ${value}">${value}</span>` : escapeText(value));
const nameOr = (value) => escapeText(value) || "(no name)";
const breakable = (value) => escapeText(value).replaceAll("_", "_<wbr>");

// rows, columns: of DataTables.    asks: filter -> what a row has of it, one value or a list.    words: of a row, to be
// searched.    label: (ask, value) -> its words.
function startTable({ rows, columns, asks, words, label = (_, value) => value }) {
  const byId = (id) => document.getElementById(id);
  const MAX_OPTIONS = 500, MAX_PRINTED = 500;
  const table = new DataTable("#images", {
    data: rows,
    columns,
    order: [],
    autoWidth: false,
    deferRender: true,
    pageLength: 25,
    layout: { topStart: "info", topEnd: "pageLength", bottomStart: null, bottomEnd: "paging" },
  });
  const scroller = byId("images").closest(".dt-layout-table");
  for (const [name, value] of [["role", "region"], ["tabindex", "0"], ["aria-label", "Table of images"]]) scroller.setAttribute(name, value);

  const selects = Object.fromEntries(Object.keys(asks).map((ask) => [ask, byId(`filter-${ask}`)]));
  for (const [ask, select] of Object.entries(selects)) {
    const found = [...new Set(rows.flatMap(asks[ask]))].map((value) => [label(ask, value), value]);
    found.sort((a, b) => a[0].localeCompare(b[0], undefined, { numeric: true }));
    if (found.length <= MAX_OPTIONS) for (const [text, value] of found) select.add(new Option(text, value));
    select.parentElement.hidden = found.length < 2 || found.length > MAX_OPTIONS;
  }

  function filter() {
    const sought = byId("filter-text").value.toLowerCase().split(/\s+/).filter(Boolean);
    const wanted = Object.entries(selects).filter(([, select]) => select.value).map(([ask, select]) => [asks[ask], select.value]);
    table.search.fixed("filters", (_, row) =>
      wanted.every(([ask, value]) => [ask(row)].flat().includes(value)) &&
      sought.every((word) => words(row).toLowerCase().includes(word)));
    table.draw();
  }
  function choose(ask, value) {
    form.reset();
    const select = selects[ask];
    if (![...select.options].some((option) => option.value === value)) select.add(new Option(label(ask, value), value));
    select.value = value;
    select.parentElement.hidden = false;
    setTimeout(filter); // after the form's own reset
  }
  const form = byId("filters");
  let waiting;
  form.addEventListener("input", () => { clearTimeout(waiting); waiting = setTimeout(filter, 120); });
  form.addEventListener("submit", (event) => { event.preventDefault(); filter(); });
  form.addEventListener("reset", () => setTimeout(filter));
  document.addEventListener("click", (event) => {
    const link = event.target.closest("a.ask");
    if (!link) return;
    choose(link.dataset.ask, link.dataset.value);
    event.preventDefault();
    byId("images-heading").scrollIntoView();
    byId("images-heading").focus({ preventScroll: true });
  });

  // paper shows what is open on the screen, and the rows that the filters leave
  let length = 25;
  window.addEventListener("beforeprint", () => { length = table.page.len(); table.page.len(MAX_PRINTED).draw(); });
  window.addEventListener("afterprint", () => { table.page.len(length).draw(); });
}
