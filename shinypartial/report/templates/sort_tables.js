for (const button of document.querySelectorAll('.board th button')) button.addEventListener('click', () => {
  const head = button.parentElement, body = head.closest('table').tBodies[0];
  const column = head.cellIndex, falling = head.getAttribute('aria-sort') === 'none' || !head.hasAttribute('aria-sort')
    ? head.dataset.first === 'descending' : head.getAttribute('aria-sort') === 'ascending';
  for (const other of head.parentElement.cells) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', falling ? 'descending' : 'ascending');
  const key = row => row.cells[column].dataset.value;
  const compare = (a, b) => {
    if (key(a) === '' || key(b) === '') return (key(a) === '') - (key(b) === '');
    const order = head.dataset.kind === 'text' ? key(a).localeCompare(key(b)) : key(a) - key(b);
    return falling ? -order : order;
  };
  const rows = [...body.rows].sort((a, b) =>
    b.classList.contains('oracle') - a.classList.contains('oracle') || compare(a, b));
  body.append(...rows);
});
