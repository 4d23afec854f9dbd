// What the page needs of an OpenAPI document. Pure functions: nothing here touches the page.

const TYPES_OF_TEXT = /^(application\/.*json|text\/)/;

/** Every operation but HEAD: { id, method, path, tag, summary, description, parameters, bodies, answers, open }. */
export function operationsOf(contract) {
  const found = [];
  for (const [path, methods] of Object.entries(contract.paths)) {
    for (const [method, told] of Object.entries(methods)) {
      if (method === 'head') continue;
      found.push({
        id: told.operationId,
        method,
        path,
        tag: told.tags?.[0] ?? '',
        summary: told.summary ?? '',
        description: told.description ?? '',
        parameters: told.parameters ?? [],
        bodies: told.requestBody?.content ?? {},
        answers: told.responses ?? {},
      });
    }
  }
  return found;
}

/** The operations by the contract's tags, in its order; what has another tag comes last. */
export function byTag(contract, operations) {
  const groups = new Map((contract.tags ?? []).map((tag) => [tag.name, { ...tag, operations: [] }]));
  for (const operation of operations) {
    if (!groups.has(operation.tag)) groups.set(operation.tag, { name: operation.tag, operations: [] });
    groups.get(operation.tag).operations.push(operation);
  }
  return [...groups.values()].filter((group) => group.operations.length > 0);
}

/** Whether all words of a search occur in what is said of the operation. */
export function matches(operation, search) {
  const { method, path, summary, description, answers } = operation;
  const refusals = Object.values(answers).map((answer) => answer.description);
  const text = [method, path, summary, description, ...refusals].join(' ').toLowerCase();
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

/** A schema in a few words: "string, date-time", "FieldDocument", "array of number". */
export function typeOf(schema = {}) {
  if (schema.$ref) return nameOf(schema.$ref);
  const choices = schema.anyOf ?? schema.oneOf;
  if (choices) return choices.map(typeOf).join(' or ');
  if (schema.enum) return schema.enum.map((value) => JSON.stringify(value)).join(', ');
  if (schema.const !== undefined) return JSON.stringify(schema.const);
  if (schema.type === 'array') return `array of ${typeOf(schema.items) || 'anything'}`;
  return [schema.type, schema.format].filter(Boolean).join(', ');
}

export const nameOf = (reference) => reference.split('/').pop();

/** The first example of a body, as text to edit; '' where the contract has none. */
export function exampleOf(body) {
  const [first] = Object.values(body.examples ?? {});
  return first ? JSON.stringify(first.value, null, 2) : '';
}

/** Whether a body of this media type is typed as text, and not chosen as a file. */
export const isText = (mediaType) => TYPES_OF_TEXT.test(mediaType);

/** The address with its parameters filled in. Throws an Error that names a required one without a value. */
export function addressOf(operation, values) {
  const query = new URLSearchParams();
  let path = operation.path;
  for (const parameter of operation.parameters) {
    const value = (values[parameter.name] ?? '').trim();
    if (!value && parameter.required) throw new Error(`${parameter.name} is required`);
    if (parameter.in === 'path') path = path.replace(`{${parameter.name}}`, encodeURIComponent(value));
    if (parameter.in === 'query' && value) query.append(parameter.name, value);
  }
  const asked = query.toString();
  return asked ? `${path}?${asked}` : path;
}

/** The headers among the parameters that have a value. */
export function headersOf(operation, values) {
  const given = operation.parameters.filter(({ name, in: place }) => place === 'header' && (values[name] ?? '').trim());
  return Object.fromEntries(given.map(({ name }) => [name, values[name].trim()]));
}
