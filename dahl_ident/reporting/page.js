"use strict";
// Click on a header sorts its table; numbers by their full value, text by language.
const valueOf = (cell) => (cell.dataset.value === undefined ? NaN : Number(cell.dataset.value));
for (const header of document.querySelectorAll("thead th:has(button)")) {
  header.querySelector("button").addEventListener("click", () => {
    const body = header.closest("table").tBodies[0];
    const column = header.cellIndex;
    const rising = header.getAttribute("aria-sort") !== "ascending";
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [a.cells[column], b.cells[column]];
      const difference = valueOf(x) - valueOf(y);
      const order = Number.isNaN(difference)
        ? x.textContent.localeCompare(y.textContent, undefined, { numeric: true })
        : difference;
      return rising ? order : -order;
    });
    for (const other of header.parentElement.cells) other.setAttribute("aria-sort", "none");
    header.setAttribute("aria-sort", rising ? "ascending" : "descending");
    body.append(...rows);
  });
}
// Tables are copied with tabs between cells and every digit, for spreadsheets.
const tableText = (table) =>
  [...table.rows]
    .map((row) => [...row.cells].map((c) => c.dataset.value ?? c.textContent.trim()).join("\t"))
    .join("\n");
const copy = async (text) => {
  if (navigator.clipboard && window.isSecureContext) {
    await navigator.clipboard.writeText(text);
    return;
  }
  const area = document.createElement("textarea");
  area.value = text;
  document.body.append(area);
  area.select();
  document.execCommand("copy");
  area.remove();
};
for (const button of document.querySelectorAll("button.copy")) {
  button.addEventListener("click", async () => {
    const box = button.closest(".table, .listing");
    const text =
      button.dataset.copy === "table"
        ? tableText(box.querySelector("table"))
        : box.querySelector("pre").textContent;
    try {
      await copy(text);
      button.textContent = "Copied";
    } catch {
      button.textContent = "Not allowed";
    }
    setTimeout(() => { button.textContent = "Copy"; }, 1500);
  });
}
