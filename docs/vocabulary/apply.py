#!/usr/bin/env python3
"""Applies rename tables to the tokens of all source files: apply.py [--check] REPOSITORY TABLE...

Tables whose names end in -pre.tsv hold regular expressions (path glob, pattern, replacement); they are applied first.
The format of the other tables is described in README.md. --check changes nothing and lists unused rules and collisions."""
import sys,re,os,subprocess,fnmatch,collections,glob
args=sys.argv[1:]
check='--check' in args
args=[a for a in args if a!='--check']
repo,tables=args[0],[os.path.abspath(a) for a in args[1:]]
os.chdir(repo)
files=[f for f in subprocess.check_output(['git','ls-files','-z']).decode().split('\0') if f]
EXT=('.rs','.wgsl','.ts','.toml','.json','.md','.py','.sh','.html','.css','.js','.mjs')
files=[f for f in files if f.endswith(EXT) or f=='Makefile']
files=[f for f in files if not f.endswith('package-lock.json') and f!='Cargo.lock' and not f.startswith('docs/figures/')]
pre=[t for t in tables if t.endswith('-pre.tsv')]
tables=[t for t in tables if t not in pre]
rules=[];moves=[];bad=0
for t in tables:
    for n,line in enumerate(open(t),1):
        line=line.rstrip('\n')
        if not line.strip() or line.startswith('#'): continue
        p=[x.strip() for x in line.split('\t')]
        if p[0]=='FILE':
            moves.append((p[1],p[2])); continue
        if len(p)<3: print(f'{t}:{n}: bad line {line!r}'); bad+=1; continue
        scope,old,new=p[:3]; flags=(p[3] if len(p)>3 else 'code')
        if not re.fullmatch(r'[A-Za-z_][A-Za-z0-9_]*',old) or not re.fullmatch(r'[A-Za-z_][A-Za-z0-9_]*',new):
            if not ('key' in flags and re.fullmatch(r'[A-Za-z_][A-Za-z0-9_.-]*',old)):
                print(f'{t}:{n}: not identifiers {line!r}'); bad+=1; continue
        if old==new: continue
        for s in re.split(r'[ ,]+',scope):
            rules.append((s,old,new,flags,f'{os.path.basename(t)}:{n}'))
def rx(scope):
    if scope=='*': return None
    s=re.escape(scope).replace(r'\*\*/',"(?:.*/)?").replace(r'\*\*','.*').replace(r'\*','[^/]*')
    return re.compile(s+r'$')
cache={}
unused=collections.Counter()
def spec(s): return -1 if s=='*' else len(s.split('*')[0])+(1000 if '*' not in s else 0)
byscope=collections.defaultdict(list)
for r in rules: byscope[r[0]].append(r)
def rules_of(f):
    d={}
    for s in sorted(byscope,key=spec):
        if s not in cache: cache[s]=rx(s)
        if s=='*' or cache[s].match(f):
            for r in byscope[s]:
                o=d.get(r[1])
                if o and o[1]!=r[2] and spec(o[0])==spec(r[0]): print(f'conflict in {f}: {o[4]} {o[1]} / {r[4]} {r[2]} for {r[1]}')
                d[r[1]]=(r[0],r[2],r[3],r[1],r[4])
    return d
RUST=re.compile(r'''(?P<lc>//[^\n]*)|(?P<bc>/\*.*?\*/)|(?P<raw>b?r(?P<h>\#*)".*?"(?P=h))|(?P<str>b?"(?:\\.|[^"\\])*")|(?P<chr>b?'(?:\\.[^']*|[^\\'])')|(?P<life>'[A-Za-z_]\w*)|(?P<id>[A-Za-z_]\w*)|(?P<oth>.)''',re.S)
TS=re.compile(r'''(?P<lc>//[^\n]*)|(?P<bc>/\*.*?\*/)|(?P<tpl>`(?:\\.|[^`\\])*`)|(?P<str>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*')|(?P<id>[A-Za-z_$]\w*)|(?P<oth>.)''',re.S)
PY=re.compile(r'''(?P<lc>\#[^\n]*)|(?P<str>[fbr]*"""(?:.*?)"""|[fbr]*"(?:\\.|[^"\\\n])*"|[fbr]*'(?:\\.|[^'\\\n])*')|(?P<id>[A-Za-z_]\w*)|(?P<oth>.)''',re.S)
ID=re.compile(r'[A-Za-z_]\w*')
used=collections.Counter()
def sub_ids(text,d,pred=lambda r:True):
    def g(m):
        r=d.get(m[0])
        if r and pred(r): used[r[4]]+=1; return r[1]
        return m[0]
    return ID.sub(g,text)
def iskey(r): return 'key' in r[2]
def ticks(text,d,pred=lambda r:True):
    return re.sub(r'`[^`\n]+`',lambda m:sub_ids(m[0],d,pred),text)
def string(text,d):
    # inline captures of format strings
    def cap(m):
        r=d.get(m[2])
        if r and m[1]=='{': used[r[4]]+=1; return m[1]+r[1]+m[3]
        return m[0]
    text=re.sub(r'(\{)([A-Za-z_]\w*)(\}|:[^{}"]*\})',cap,text)
    text=re.sub(r'(\{[A-Za-z_]*:[^{}"]*?)([a-z_]\w*)(\$)',lambda m:(m[1]+d[m[2]][1]+m[3]) if m[2] in d else m[0],text)
    def key(m):
        r=d.get(m[0])
        if not(r and iskey(r)): return m[0]
        a,b=text[:m.start()],text[m.end():]
        pre=a[-1:] ; post=b[:1]
        if '_' in m[0]: used[r[4]]+=1; return r[1]
        if pre in '"\'`' and (post in '"\'`\\' ) : used[r[4]]+=1; return r[1]
        if re.match(r'\s*=[^=]',b) and re.search(r'(^|[\n{,\["\.\s])$',a): used[r[4]]+=1; return r[1]
        if pre=='.' and re.search(r'[\w\]]\.$',a): used[r[4]]+=1; return r[1]
        if post=='.' and re.match(r'\.[a-z]',b) and pre in '"`[ .': used[r[4]]+=1; return r[1]
        if pre in '[.' and post in '].': used[r[4]]+=1; return r[1]
        return m[0]
    return ID.sub(key,text)
def collide(f,src,toks,d):
    """New names that already are bare identifiers in the same function as the old one."""
    out=set()
    # functions: spans between 'fn' tokens
    start=[i for i,(k,t) in enumerate(toks) if k=='id' and t=='fn']+[len(toks)]
    prev=0
    for s in start:
        seg=toks[prev:s]; prev=s
        bare=set()
        for i,(k,t) in enumerate(seg):
            if k!='id': continue
            p=next((x for x in range(i-1,-1,-1) if not seg[x][1].isspace()),None)
            q=next((x for x in range(i+1,len(seg)) if not seg[x][1].isspace()),None)
            pt=seg[p][1] if p is not None else ''
            qt=seg[q][1] if q is not None else ''
            if pt=='.' : continue
            if qt in '(!' and qt: continue
            if qt==':' and q+1<len(seg) and seg[q+1][1]==':' : continue
            bare.add(t)
        for o in bare:
            r=d.get(o)
            if r and r[1] in bare and r[1] not in d: out.add((o,r[1],r[4]))
    return out
def serde_path(out):
    """Whether the next string is a path in a serde attribute."""
    before=[t for t in out[-6:] if not t.isspace()]
    return len(before)>1 and before[-1]=='=' and before[-2] in ('default','with','deserialize_with','serialize_with','skip_serializing_if')
changed={}
allcol=[]
edits=[]
for t in pre:
    for line in open(t):
        if line.strip() and not line.startswith('#'):
            scope,pattern,new=line.rstrip('\n').split('\t')[:3]
            edits.append((rx(scope) or re.compile('.*'),re.compile(pattern),new))
for f in files:
    try: src=open(f).read()
    except UnicodeDecodeError: continue
    original=src
    for scope,pattern,new in edits:
        if scope.match(f): src=pattern.sub(new,src)
    d=rules_of(f)
    if not d:
        if src!=original: changed[f]=src
        continue
    if f.endswith(('.rs','.wgsl','.ts','.js','.mjs','.py')):
        R=RUST if f.endswith(('.rs','.wgsl')) else PY if f.endswith('.py') else TS
        toks=[(m.lastgroup if m.lastgroup!='h' else 'raw',m[0]) for m in R.finditer(src)]
        toks=[('raw' if t.startswith(('r"','r#"','br"','br#"')) and k not in('id','oth','lc','bc') else k,t) for k,t in toks]
        if not f.endswith('.py'):
            col=collide(f,src,toks,d)
            for o,n,w in sorted(col): allcol.append((f,o,n,w))
        out=[]
        py=f.endswith('.py')
        dd={k:v for k,v in d.items()}
        for k,t in toks:
            if k=='id':
                r=dd.get(t)
                if r and not (py and r[0]=='*' and not iskey(r)): used[r[4]]+=1; t=r[1]
            elif k in('lc','bc'): t=ticks(t,d)
            elif k=='str' and serde_path(out): t=sub_ids(t,d)
            elif k in('str','raw'): t=string(t,d)
            elif k=='tpl':
                t=re.sub(r'\$\{[^}]*\}',lambda m:sub_ids(m[0],d),t); t=string(t,d)
            out.append(t)
        new=''.join(out)
    elif f.endswith('.md'):
        def fence(m): return string(m[0],{k:v for k,v in d.items()}) 
        parts=re.split(r'(```.*?```)',src,flags=re.S)
        new=''.join(re.sub(ID,lambda m:(d[m[0]][1] if m[0] in d and (('_' in m[0] and (iskey(d[m[0]]) or d[m[0]][0]=='*')) or (iskey(d[m[0]]) and False)) else m[0]),string(p,d)) if p.startswith('```') else
            re.sub(r'`[^`\n]+`',lambda m:re.sub(ID,lambda i:(d[i[0]][1] if i[0] in d and (iskey(d[i[0]]) or '_' in i[0] or i[0][0].isupper()) else i[0]),m[0]),p) for p in parts)
    elif f.endswith(('.html','.css')):
        new=sub_ids(src,d,lambda r:iskey(r) and r[0]!='*' or (iskey(r) and '_' in r[3]))
    else: # toml json sh Makefile
        def key(m):
            r=d.get(m[0])
            if not(r and iskey(r)): return m[0]
            a,b=src[:m.start()],src[m.end():]
            if f.endswith('.json'):
                ok=a[-1:]=='"' and b[:1]=='"'
            elif f.endswith('.toml'):
                line=a.rsplit('\n',1)[-1]
                if '#' in line: ok='_' in m[0]
                else: ok=bool(re.match(r'\s*=',b)) or bool(re.search(r'\[[\w."-]*$',line)) or (a[-1:]=='"' and b[:1]=='"')
            else: ok='_' in m[0] or (a[-1:]=='"' and b[:1]=='"')
            if ok: used[r[4]]+=1; return r[1]
            return m[0]
        new=ID.sub(key,src)
    if new!=original: changed[f]=new
for c in allcol: print('collision',*c)
nu=[r for r in rules if not used[r[4]]]
print(f'{len(rules)} rules, {len(changed)} files change, {len(allcol)} collisions, {len(nu)} unused, {bad} bad')
if check:
    for r in nu[:40]: print('unused',r[4],r[0],r[1])
else:
    for f,n in changed.items(): open(f,'w').write(n)
    for a,b in moves:
        if not os.path.exists(a): print('no file',a); continue
        os.makedirs(os.path.dirname(b),exist_ok=True); subprocess.call(['git','mv',a,b])
