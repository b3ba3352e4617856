"use strict";
// files dropped anywhere on the form are those of its input
for (const form of document.querySelectorAll("form.drop")) {
  const input = form.querySelector("input[type=file]");
  form.addEventListener("dragover", e => { e.preventDefault(); form.classList.add("over"); });
  form.addEventListener("dragleave", () => form.classList.remove("over"));
  form.addEventListener("drop", e => {
    e.preventDefault();
    form.classList.remove("over");
    input.files = e.dataTransfer.files;
  });
}
const progress = document.getElementById("progress");
if (progress) {
  const look = async () => {
    const state = await (await fetch(progress.dataset.state)).json();
    if (!state.busy) { location.reload(); return; }
    progress.lastElementChild.textContent = state.text;
    setTimeout(look, 500);
  };
  setTimeout(look, 300);
}
const commands = document.getElementById("commands");
if (commands) {
  const form = document.querySelector("form");
  const show = async () => {
    const body = new URLSearchParams(new FormData(form));
    const answer = await fetch(commands.dataset.of, { method: "POST", body });
    if (!answer.ok) return;
    const texts = await answer.json();
    const [typed, program] = commands.querySelectorAll("pre");
    typed.textContent = texts.commands;
    program.textContent = texts.program;
  };
  form.addEventListener("change", show);
  show();
}
